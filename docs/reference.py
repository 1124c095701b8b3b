# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Make the API reference, as pages: of each name that docs/api.md declares public, and no other.

``make docs`` writes it to ``docs_output/``.  A name that is not there, or has no docstring, is an
error, and so is any warning.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
import warnings
from pathlib import Path

import pdoc

DOCS = Path(__file__).parent
PACKAGE = "ofsat_ros"


def declared(text: str) -> dict[str, list[str]]:
    """Return the public names of each module, from the table in the text of docs/api.md."""
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| ([^|]+) \|$", text, re.M)
    return {module: re.findall(r"`(\w+)`", names) for module, names in rows}


def restrict(module: str, names: list[str]) -> None:
    """Let a module show some names only, each of which must be there and documented."""
    front = importlib.import_module(f"{PACKAGE}.{module}")
    for name in names:
        value = getattr(front, name)
        if callable(value) and not inspect.getdoc(value):
            raise ValueError(f"{PACKAGE}.{module}.{name} has no docstring")
        setattr(front, name, value)  # some are loaded only when they are asked for
    front.__all__ = names  # type: ignore[attr-defined]


def write(folder: Path) -> None:
    """Write the pages into a folder; ``index.html`` leads to them."""
    public = declared((DOCS / "api.md").read_text())
    for module, names in public.items():
        restrict(module, names)
    importlib.import_module(PACKAGE).__all__ = list(public)  # type: ignore[attr-defined]
    pdoc.render.configure(docformat="numpy", show_source=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pdoc.pdoc(PACKAGE, output_directory=folder)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
