# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat suggest``: parameters that suit a recording, with the reasons."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
from itertools import islice
from pathlib import Path
from typing import Any

import click

from ofsat_ros.cli.terminal import (
    fail,
    help_all,
    recording_argument,
    recording_options,
    say,
    spare_existing,
)
from ofsat_ros.pipeline import ImageError
from ofsat_ros.recordings import RecordingError, open_recording
from ofsat_ros.report.words import process_words
from ofsat_ros.suggestion import Measurement, Suggestion, measure, suggest


@click.command("suggest", epilog="Example: ofsat suggest night1 --pixel-scale 5")
@recording_argument
@recording_options
@click.option(
    "--pixel-scale",
    type=click.FloatRange(min=0, min_open=True),
    metavar="ARCSEC",
    help="what a pixel spans on the sky, if the recording does not tell",
)
@click.option(
    "--frames",
    "count",
    type=click.IntRange(3),
    default=20,
    show_default=True,
    help="frames to look at, from the first on",
)
@click.option(
    "--yaml",
    "file",
    type=click.Path(dir_okay=False, path_type=Path),
    help="also write the changed parameters to FILE, for the detector's --params-file",
)
@click.option("--force", is_flag=True, help="replace FILE")
@click.option("--json", "as_json", is_flag=True, help="print JSON instead of words")
@help_all
def command(
    paths: tuple[Path, ...],
    pixel_scale: float | None,
    count: int,
    file: Path | None,
    force: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Propose parameters for RECORDING: how much to smooth, what history, and why."""
    try:
        spare_existing(file, force)
        with open_recording(paths, **options) as recording:
            measured = measure(islice(recording, count))
            for problem in recording.problems:
                say(f"note: {problem}")
        if pixel_scale is not None:
            measured = dataclasses.replace(measured, pixel_scale_arcsec=pixel_scale)
        suggestion = suggest(measured)
        if file is not None:
            file.write_text(_yaml(suggestion), encoding="utf-8")
    except ImageError as error:
        fail(f"no frame of {paths[0]} could be processed: {error}")
    except (RecordingError, OSError) as error:
        fail(error)
    if as_json:
        click.echo(json.dumps(suggestion.as_dict(), indent=2))
        return
    click.echo("\n".join(_words(suggestion)))
    words = process_words(paths, options | suggestion.changes)
    click.echo(f"\n{shlex.join(words)}")


def _words(suggestion: Suggestion) -> list[str]:
    measured = suggestion.measured
    lines = [f"{name + ':':<17} {value}" for name, value in _facts(measured).items()]
    lines += ["", f"{'parameter':<19} {'default':>7} {'better':>7}  why"]
    for p in suggestion.proposals:
        value = "same" if p.value == p.default else f"{p.value}"
        lines.append(f"{p.name:<19} {p.default!s:>7} {value:>7}  {p.reason}")
    lines += [f"note: {note}" for note in suggestion.notes]
    return lines


def _facts(m: Measurement) -> dict[str, str]:
    """What was measured, in words; what is not known is left out."""
    facts = {
        "frames": f"{m.frames} of {m.width}x{m.height} px"
        + _if_known(m.interval_s, f", one every {m.interval_s:.4g} s")
        + _if_known(m.exposure_s, f", exposed {m.exposure_s:.4g} s"),
        "stars": _if_known(m.psf_sigma_px, f"FWHM {m.fwhm_px:.2f} px")
        + (f", streaks of {m.streak_px:.1f} px" if m.streak_px > 0 else ""),
        "sky": f"{m.background:.5g} DN, noise {m.pixel_noise:.3g} DN in a pixel",
        "objects": f"{m.objects:.0f} a frame",
        "field's motion": _if_known(
            m.field_px, f"{m.field_px:.2f} px a frame, stars {m.field_residual_px:.2g} px about it"
        ),
        "pixel": _if_known(m.pixel_scale_arcsec, f'{m.pixel_scale_arcsec:.4g}" on the sky'),
        "time": f"{1e3 * m.seconds:.0f} ms a frame on this machine",
    }
    return {name: value for name, value in facts.items() if value}


def _if_known(value: float, words: str) -> str:
    return words if math.isfinite(value) else ""


def _yaml(suggestion: Suggestion) -> str:
    """Return the changed parameters as a file for ROS, each with its reason."""
    lines = ["# For: ros2 run ofsat_ros detector --ros-args --params-file", "/**:"]
    lines.append("  ros__parameters:" if suggestion.changes else "  ros__parameters: {}")
    for p in suggestion.proposals:
        if p.name in suggestion.changes:
            lines += [f"    # {p.reason}", f"    {p.name}: {p.value}"]
    return "\n".join([*lines, ""])
