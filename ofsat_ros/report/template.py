# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pages out of ``page/``'s templates: whole, escaped, and with the words of words.py."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from ofsat_ros.report import words

_TEMPLATES = Path(__file__).with_name("page")


def page_template(name: str) -> Any:
    """Return the jinja2 template of that name in ``page/``, which escapes what it is given.

    Raises
    ------
    ModuleNotFoundError
        If jinja2 is missing; the message names the extra that brings it.
    """
    try:
        import jinja2
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "the report needs jinja2: pip install 'ofsat_ros[report]'", name=error.name
        ) from error
    return _templates(jinja2).get_template(name)


@cache
def _templates(jinja2: Any) -> Any:
    """Made once: a batch writes hundreds of pages."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        **{"number": words.number, "instant": words.instant, "duration": words.duration},
        **{"plural": words.count},
    }
    return environment
