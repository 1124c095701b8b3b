"""Running the ``ofsat`` command in tests, within this process or as a program."""

import os
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner, Result

import ofsat_ros
from ofsat_ros.cli import main


def ofsat(*arguments: object) -> Result:
    # The report, a second look at the whole recording, is tested for itself.
    quick = {"process": {"report": False}}
    return CliRunner().invoke(main, [str(a) for a in arguments], default_map=quick)


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
