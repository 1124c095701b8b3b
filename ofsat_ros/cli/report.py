# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat report``: a page, or a video, of results that are there."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from ofsat_ros.cli.terminal import fail, say, spare_existing
from ofsat_ros.recordings import RecordingError
from ofsat_ros.report import write_report, write_video
from ofsat_ros.results import ResultError


@click.command("report", epilog="Example: ofsat report my_results --video my_results/night.mp4")
@click.argument("results", type=click.Path(path_type=Path))
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="where the recording is now, if not where it was",
)
@click.option(
    "--video",
    type=click.Path(dir_okay=False, path_type=Path),
    help="also write the frames with what was found, as FILE.mp4 or FILE.gif",
)
@click.option("--force", is_flag=True, help="replace a video that exists")
def command(results: Path, recording: Path | None, video: Path | None, force: bool) -> None:
    """Make a page that shows RESULTS, a folder made by process.

    The page is one file, report.html in that folder, to be opened in a browser or sent to others.
    It takes its pictures from the recording; without that, it has all but the pictures.
    """
    if recording is not None and not recording.exists():
        fail(f"there is nothing at {recording}")
    made: list[Path] = []
    try:
        spare_existing(video, force)
        made.append(write_report(results, recording, say))
        if video is not None:
            made.append(write_video(results, video, recording))
    except (ImportError, RecordingError, ResultError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        say(f"stopped; {_written(made)}")
        sys.exit(130)
    click.echo(_written(made))


def _written(made: list[Path]) -> str:
    names = " and ".join(map(str, made)) or "nothing"
    return f"{names} {'are' if len(made) > 1 else 'is'} written"
