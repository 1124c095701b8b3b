"""The ``ofsat`` command: what needs no ROS graph.

Each command is a module of this package, which is imported only when it is called; ``terminal`` is
what they share: words to the user, options out of the parameters' tables.  Exit code 0: done; 1:
the input or output is not usable; 2: bad usage; 130: stopped by Ctrl-C, with what was done so far
on disk.  The summary goes to standard output; progress, notes and errors to standard error.
"""

from __future__ import annotations

import importlib

import click

from ofsat_ros import __version__

__all__ = ["main"]

# In the order in which a user meets them.
_COMMANDS = {
    "process": "Detect RSOs in a recording.",
    "evaluate": "Compare results with truth.",
    "simulate": "Make a recording of simulated frames.",
}


class _Commands(click.Group):
    """Imports a command's module when somebody calls it, so that ``ofsat --help`` is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module = importlib.import_module(f"{__name__}.{cmd_name}")
        command: click.Command = module.command
        return command


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 99},
)
@click.version_option(__version__, prog_name="ofsat")
def main() -> None:
    """Find satellites and debris in recordings of a telescope camera."""
