# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat completion``: what makes a shell complete commands, options and their values."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

# The line for the file that each shell reads when it starts, and that file.
_LINES = {
    "bash": ('eval "$(ofsat completion bash)"', "~/.bashrc"),
    "zsh": ('eval "$(ofsat completion zsh)"', "~/.zshrc, after compinit"),
    "fish": ("ofsat completion fish | source", "~/.config/fish/config.fish"),
}
_HELP = "\n".join(
    [
        "Print what makes SHELL complete ofsat's commands and options when Tab is pressed.",
        "\n\b\nPut a line into the file that your shell reads when it starts:",
        *(f"  {line:<34}  in {file}" for line, file in _LINES.values()),
    ]
)


@click.command("completion", help=_HELP, epilog=f"Example: {_LINES['bash'][0]}")
@click.argument("shell", type=click.Choice(list(_LINES)))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print the script of a shell, which calls ofsat again for every Tab."""
    script = get_completion_class(shell)
    if script is None:
        raise click.UsageError(f"this version of click knows no completion for {shell}")
    click.echo(script(context.find_root().command, {}, "ofsat", "_OFSAT_COMPLETE").source())
