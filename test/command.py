# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Running the ``ofsat`` command in tests, within this process or as a program."""

import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

import ofsat_ros
from ofsat_ros.cli import main

# Before click 8.2, what goes to stdout and to stderr was one, unless asked for otherwise.
_APART = {"mix_stderr": False} if "mix_stderr" in inspect.signature(CliRunner).parameters else {}


class _Runner(CliRunner):
    @contextmanager
    def isolation(self, *arguments: Any, **how: Any) -> Iterator[Any]:
        with super().isolation(*arguments, **how) as outputs:
            sys.stderr.reconfigure(write_through=True)  # older ones did not flush it
            yield outputs


def invoke(*arguments: object, **how: Any) -> Result:
    return _Runner(**_APART).invoke(main, [str(a) for a in arguments], **how)


def ofsat(*arguments: object) -> Result:
    # The report, a second look at the whole recording, is tested for itself.
    quick = {"process": {"report": False}}
    return invoke(*arguments, default_map=quick)


def succeeds(*arguments: object) -> Result:
    done = ofsat(*arguments)
    assert done.exit_code == 0, done.output
    return done


def fails(code: int, *arguments: object) -> str:
    """Run what must fail, without a traceback; return what it says, on one line."""
    done = ofsat(*arguments)
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == code, done.output
    assert done.stdout == ""
    return " ".join(done.stderr.split())


def environment() -> dict[str, str]:
    """What the program needs to find this package."""
    package = Path(ofsat_ros.__file__).parent.parent
    return {**os.environ, "PYTHONPATH": f"{package}", "COLUMNS": "200"}


def subprocess_ofsat(*arguments: object, **options) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "ofsat_ros.cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        **options,
    )
