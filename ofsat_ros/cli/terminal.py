"""What the commands share: words to the user, options from the tables, folders to write to."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import click
from tqdm import tqdm

from ofsat_ros.parameters import Description, Table
from ofsat_ros.recordings import RecordingError

_Command = Callable[..., None]


def parameter_options(*tables: type[Table]) -> Callable[[_Command], _Command]:
    """Add an option for each parameter of the tables to a command."""
    abouts = [about for table in tables for about in table.describe()]

    def add(command: _Command) -> _Command:
        for about in reversed(abouts):
            allowed = f"{about.allowed} {about.unit}".strip()
            option = click.option(
                f"--{about.name.replace('_', '-')}",
                about.name,
                type=_option_type(about),
                help=f"{about.meaning} [{about.stage}; {allowed}]",
            )
            command = option(command)
        return command

    return add


def _option_type(about: Description) -> Any:
    return click.Choice(about.choices) if about.choices else type(about.default)


def of_table(table: type[Table], given: dict[str, Any]) -> dict[str, Any]:
    """Return those of the given values that are a table's."""
    names = {about.name for about in table.describe()}
    return {name: value for name, value in given.items() if name in names}


def claim(folder: Path, files: list[str], force: bool) -> None:
    """Make the folder for the results, or refuse to overwrite those that it holds."""
    folder.mkdir(parents=True, exist_ok=True)
    old = [name for name in files if (folder / name).exists()]
    if old and not force:
        raise RecordingError(
            f"{folder} already holds {', '.join(old)}; choose another folder, or --force to"
            " replace them"
        )
    # What is not made this time must not stay beside what is.
    for name in old:
        (folder / name).unlink()


def fail(error: Exception | str) -> NoReturn:
    """End the command with exit code 1 and a line that says why."""
    if isinstance(error, OSError) and error.strerror:
        error = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    say(f"ofsat: {error}")
    sys.exit(1)


def say(line: str) -> None:
    """One line on standard error, beside the progress bar."""
    tqdm.write(line, file=sys.stderr)
