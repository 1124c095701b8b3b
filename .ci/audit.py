# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Ask an advisory service about every package that is installed here, and say what it knew.

``pip-audit`` ends well, with "No known vulnerabilities found", also where no service could be
reached.  This does not: it says how many packages were looked up, and of which nothing is known.
The exit code is 1 if a package has a known vulnerability that a newer version mends.
"""

from __future__ import annotations

import json
import subprocess
import sys

PATIENCE_S = 300.0


def main() -> int:
    """Print the findings; return the exit code."""
    command = [sys.executable, "-m", "pip_audit", "--format", "json", "--progress-spinner", "off"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
        packages = json.loads(done.stdout)["dependencies"]
    except (subprocess.TimeoutExpired, ValueError, KeyError) as error:
        print(f"audit: NOT AUDITED: pip-audit gave no answer ({type(error).__name__})")
        return 0
    lines, code = report(packages)
    print("\n".join(lines))
    return code


def report(packages: list[dict]) -> tuple[list[str], int]:
    """Return what to say of pip-audit's answer, and the exit code."""
    unknown = [each for each in packages if "skip_reason" in each]
    known = len(packages) - len(unknown)
    if not known:
        why = unknown[0]["skip_reason"] if unknown else "no package is installed"
        return [
            f"audit: NOT AUDITED: nothing was learnt of any of {len(packages)} packages, so no"
            f" advisory service was reached; of the first: {why}"
        ], 0
    lines, code = [], 0
    for each in packages:
        for found in each.get("vulns", ()):
            fixed = found["fix_versions"]
            remedy = f"mended in {', '.join(fixed)}: upgrade" if fixed else "not mended yet"
            lines.append(f"audit: {each['name']} {each['version']}: {found['id']}, {remedy}")
            code = max(code, int(bool(fixed)))
    lines.append(f"audit: {known} of {len(packages)} packages looked up, {len(lines)} advisories")
    if unknown:
        lines.append(f"audit: nothing is known of {', '.join(each['name'] for each in unknown)}")
    return lines, code


if __name__ == "__main__":
    sys.exit(main())
