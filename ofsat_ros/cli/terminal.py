# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What the commands share: words to the user, options, folders to write to."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import click
from tqdm import tqdm

from ofsat_ros.parameters import (
    DEFAULT_PRESET,
    CameraParameters,
    Description,
    Parameters,
    Table,
    TrackingDataParameters,
    preset_names,
)
from ofsat_ros.printing import printable
from ofsat_ros.recordings import RecordingError, utc_ns
from ofsat_ros.results.bag import BAG
from ofsat_ros.tracking_data import TRACKING_DATA

_Command = Callable[..., None]
_ALL = f"{__name__}.all"


class _SeldomOption(click.Option):
    """An option that ``--help`` leaves out, and ``--help-all`` and completion don't."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        return super().get_help_record(ctx) if ctx.meta.get(_ALL) else None


# An option for a command with `help_all`, whose ``--help`` is to fit a screen.
seldom_option = partial(click.option, cls=_SeldomOption)


def help_all(command: _Command) -> _Command:
    """Add ``--help-all`` to a command with seldom options."""
    return click.option(
        "--help-all",
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=_show_all,
        help="show all options, those that are seldom needed too",
    )(command)


def _show_all(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()


def parameter_options(*tables: type[Table]) -> Callable[[_Command], _Command]:
    """Add a seldom option for each parameter of the tables to a command."""
    abouts = [about for table in tables for about in table.describe()]

    def add(command: _Command) -> _Command:
        for about in reversed(abouts):
            allowed = f"{about.allowed} {about.unit}".strip()
            default = about.default if about.default != "" else "none"
            option = seldom_option(
                f"--{about.name.replace('_', '-')}",
                about.name,
                type=_option_type(about),
                help=f"{about.meaning} [{about.stage}; {allowed}; default {default}]",
            )
            command = option(command)
        return command

    return add


def _option_type(about: Description) -> Any:
    return click.Choice(about.choices) if about.choices else type(about.default)


class Instant(click.ParamType):
    """A date and a time, as ns UTC."""

    name = "utc"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Read it, or say what is wrong with it."""
        if isinstance(value, int):
            return value
        try:
            return utc_ns(value)
        except ValueError as error:
            self.fail(f"{error}: give it as 2026-03-01T22:15:00Z", param, ctx)


def recording_argument(command: _Command) -> _Command:
    """Add the first argument of `open_recording`, as ``paths``."""
    path = click.Path(path_type=Path)
    return click.argument("paths", metavar="RECORDING...", nargs=-1, required=True, type=path)(
        command
    )


def recording_options(command: _Command) -> _Command:
    """Add the options of `open_recording`, each by the name of its argument."""
    positive = click.FloatRange(min=0, min_open=True)
    for add in (
        click.option(
            "--start",
            "start_ns",
            type=Instant(),
            metavar="UTC",
            help="when the first exposure began, where no frame has a time",
        ),
        click.option(
            "--exposure",
            "exposure_s",
            type=positive,
            metavar="SECONDS",
            help="length of an exposure, where no header tells it",
        ),
        click.option(
            "--fps", type=positive, metavar="RATE", help="frames per second, where none have times"
        ),
        seldom_option("--attitude-topic", help="topic of the attitude, if there are several"),
        seldom_option("--camera-info-topic", help="topic of the calibration, if several"),
        click.option("--topic", help="image topic, if the recording holds several"),
    ):
        command = add(command)
    return command


def job_options(command: _Command) -> _Command:
    """Add what a `Job` is told beside its recording, and whether a page is made of it."""
    presets = preset_names()
    for add in (
        parameter_options(Parameters, CameraParameters, TrackingDataParameters),
        click.option(
            "--live",
            is_flag=True,
            help="write what the node says at each frame, not the last word on it",
        ),
        click.option(
            "--preset",
            default=DEFAULT_PRESET,
            type=click.Choice(presets),
            metavar="NAME",
            help=f"set of parameters: {', '.join(presets)}; default: {DEFAULT_PRESET}",
        ),
        click.option(
            "--tdm",
            "formats",
            multiple=True,
            type=click.Choice(list(TRACKING_DATA)),
            help="also write angles: CCSDS TDM (text or XML) or IOD lines; repeatable",
        ),
        click.option(
            "--bag",
            is_flag=True,
            help=f"also write the bag {BAG}, that plays beside the recording",
        ),
        click.option(
            "--report/--no-report",
            default=None,
            help="with or without a page on the recording; default: with, if its extra is there",
        ),
    ):
        command = add(command)
    return command


def spare_input(recordings: Sequence[Path], target: Path) -> None:
    """Refuse to write over what is read.

    Raises
    ------
    RecordingError
        If a recording is the target, or is in it.
    """
    resolved = target.resolve()
    for path in recordings:
        if resolved in (path.resolve(), *path.resolve().parents):
            raise RecordingError(f"{path} is read, so it cannot be the output: choose another one")


def spare_existing(target: Path | None, force: bool) -> None:
    """Refuse to replace a file that is there, without being told to.

    Raises
    ------
    RecordingError
        If there is one.
    """
    if target is not None and target.exists() and not force:
        raise RecordingError(f"{target} exists: choose another name, or --force to replace it")


def fail(error: Exception | str, left: str = "") -> NoReturn:
    """End the command with exit code 1 and a line that says why, and what is left."""
    if isinstance(error, Exception) and debugging():
        traceback.print_exception(error)
    say(f"ofsat: {in_words(error)}{left}")
    sys.exit(1)


def in_words(error: Exception | str) -> str:
    """Return what an error says, without numbers of the operating system."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return f"{error}"


def debugging() -> bool:
    """Whether the user wants tracebacks (``ofsat --debug``)."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.find_root().params.get("debug"))


def say(line: str) -> None:
    """One line on standard error, beside the progress bar."""
    tqdm.write("\n".join(map(printable, line.split("\n"))), file=sys.stderr)
