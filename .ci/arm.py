# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Ask pip whether all that the package needs exists for 64-bit ARM, as on a Raspberry Pi.

Nothing is installed or built here: for each Python, pip resolves what the plain install and the
extra ``opencv`` require to wheels that an ARM machine takes, and one that is missing is an error.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
import tempfile

# pip goes by the Python that runs it where a package asks for another one only in some of them, as
# rosbags does for one that 3.14 has itself: so not that.
PYTHONS = ("3.11", "3.12", "3.13")
# Debian 12, Ubuntu 24.04 and what is newer take both.
PLATFORMS = ("manylinux2014_aarch64", "manylinux_2_28_aarch64")


def main() -> int:
    """Print what each Python would get; return the exit code."""
    needed = requirements()
    missing = 0
    for python in PYTHONS:
        with tempfile.TemporaryDirectory() as nowhere:
            done = subprocess.run(
                [*command(python, nowhere), *needed], capture_output=True, text=True
            )
        if done.returncode:
            missing += 1
            errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            print(f"arm: Python {python}: {'; '.join(errors) or done.stderr}")
        else:
            found = json.loads(done.stdout)["install"]
            names = (f"{p['metadata']['name']} {p['metadata']['version']}" for p in found)
            print(f"arm: Python {python}: {', '.join(names)}")
    return min(missing, 1)


def requirements() -> list[str]:
    """Return what the plain install and the extra ``opencv`` ask for, as pip takes it."""
    requires = importlib.metadata.requires("ofsat_ros") or []
    plain = [line for line in requires if "extra ==" not in line]
    return plain + [line.partition(";")[0] for line in requires if 'extra == "opencv"' in line]


def command(python: str, target: str) -> list[str]:
    """Return the words with which pip resolves for another machine, but fetches nothing."""
    words = ["install", "--dry-run", "--quiet", "--disable-pip-version-check", "--report", "-"]
    words += ["--ignore-installed", "--target", target, "--only-binary=:all:"]
    words += ["--python-version", python]
    for platform in PLATFORMS:
        words += ["--platform", platform]
    return [sys.executable, "-m", "pip", *words]


if __name__ == "__main__":
    sys.exit(main())
