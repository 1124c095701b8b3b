# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat evaluate``: results against truth."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ofsat_ros.cli.terminal import fail
from ofsat_ros.evaluation import (
    EvaluationError,
    count_frames,
    evaluate,
    read_detections,
    read_truth,
)


@click.command("evaluate", epilog="Example: ofsat evaluate my_results my_sky.truth.csv --list")
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--live", is_flag=True, help="count only what the node could know: from the third frame on"
)
@click.option("--candidates", is_flag=True, help="count unconfirmed detections too")
@click.option("--json", "as_json", is_flag=True, help="print JSON instead of a table")
@click.option("--list", "listed", is_flag=True, help="also list every miss and false alarm")
def command(
    results: Path, truth: Path, live: bool, candidates: bool, as_json: bool, listed: bool
) -> None:
    """Compare RESULTS, a folder made by process, with the file TRUTH.

    Recall by SNR, precision, false alarms per frame, errors of position and velocity.
    """
    try:
        evaluation = evaluate(
            read_truth(truth),
            read_detections(results),
            frames=count_frames(results),
            live=live,
            candidates=candidates,
        )
    except (EvaluationError, OSError) as error:
        fail(error)
    if as_json:
        click.echo(json.dumps(evaluation.as_dict(), indent=2))
        return
    click.echo(str(evaluation))
    if listed:
        for row in evaluation.rows("missed", "false alarm"):
            click.echo(row)
