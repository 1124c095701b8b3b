# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The ``ofsat`` command: what needs no ROS graph.

Each command is a module of this package, which is imported only when it is called; ``terminal`` is
what they share: words to the user, options out of the parameters' tables.  Exit code 0: done; 1:
the input or output is not usable, or a mistake of ours; 2: bad usage; 130: stopped by Ctrl-C, with
what was done so far on disk.  The summary goes to standard output; progress, notes and errors to
standard error.  Whoever ends the program from outside, or closes its terminal, stops it as
Ctrl-C does.  ``--debug`` shows the tracebacks that are kept from users.
"""

from __future__ import annotations

import importlib
import io
import keyword
import sys
from typing import Any

import click
from click.shell_completion import CompletionItem

from ofsat_ros import __version__
from ofsat_ros.cli.interruption import interrupted, interruptible, nothing_to_finish
from ofsat_ros.printing import printable

__all__ = ["main"]

# In the order in which a user meets them.
_COMMANDS = {
    "info": "Say what a recording holds, and whether it can be processed.",
    "import": "Turn FITS, SER, video or images into a bag.",
    "suggest": "Propose parameters that suit a recording.",
    "process": "Detect RSOs in a recording.",
    "batch": "Detect RSOs in many recordings, on many cores or machines.",
    "catalog": "List tracks of many recordings by time, place, rate, brightness.",
    "report": "Make a page, or a video, of results.",
    "evaluate": "Compare results with truth.",
    "simulate": "Make a recording of simulated frames.",
    "watch": "Show what a running detector sees, in a terminal.",
    "completion": "Print what makes a shell complete ofsat's words.",
}


class _Failure(click.ClickException):
    """What no command foresaw, told without a traceback; exit code 1."""

    def show(self, file: Any = None) -> None:
        click.echo(self.message, err=True)


class _Commands(click.Group):
    """Imports a command's module when somebody calls it, so that ``ofsat --help`` is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        name = f"{cmd_name}_" if keyword.iskeyword(cmd_name) else cmd_name
        with nothing_to_finish():
            module = importlib.import_module(f"{__name__}.{name}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_COMMANDS.items()))

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        commands = [
            CompletionItem(name, help=words)
            for name, words in _COMMANDS.items()
            if name.startswith(incomplete)
        ]
        return commands + click.Command.shell_complete(self, ctx, incomplete)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; no mistake of ours gives a traceback that nobody asked for."""
        try:
            with interruptible():
                return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise  # click knows them
        except ModuleNotFoundError as error:
            raise _Failure(
                f"ofsat: the Python module {error.name} is missing: install your system's package"
                " of it, or the extra of ofsat_ros that brings it, as in"
                " `pip install 'ofsat_ros[opencv]'`"
            ) from error
        except OSError as error:
            from ofsat_ros.cli.terminal import fail  # heavy

            fail(error)
        except KeyboardInterrupt:
            click.echo("stopped", err=True)
            sys.exit(130)
        except Exception as error:
            if interrupted(error):
                click.echo("stopped", err=True)
                sys.exit(130)
            if ctx.params["debug"]:
                raise
            raise _Failure(
                f"ofsat: {type(error).__name__}: {printable(f'{error}')}\nThis is a mistake in"
                " ofsat, not in what you did. `ofsat --debug` in place of `ofsat` shows where, for"
                " your report of it."
            ) from error


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 99},
    epilog="`ofsat COMMAND --help` tells more, with an example. Exit codes: 0 done; 1 the input or"
    " output is not usable, or a mistake in ofsat; 2 bad usage; 130 stopped by Ctrl-C, with what"
    " was done on disk.",
)
@click.version_option(__version__, prog_name="ofsat")
@click.option(
    "--debug", is_flag=True, help="show where an error arose (before the command's name)"
)
def main(debug: bool) -> None:
    """Find satellites and debris in recordings of a telescope camera."""
    # A file's name need not be Unicode.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")
