# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""For people: frames with what was found drawn on them, and a report on a whole recording.

`annotate` and `summary` are of one frame, live (picture.py).  `write_report` makes a page
(html.py) and `write_video` a film (video.py) of a folder of results; both look at the recording a
second time and can be called whenever there is one.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ofsat_ros.report.picture import Tails, annotate, summary

if TYPE_CHECKING:
    from ofsat_ros.report.html import REPORT, write_report
    from ofsat_ros.report.video import write_video

__all__ = ["REPORT", "Tails", "annotate", "summary", "write_report", "write_video"]

# Loaded when they are asked for: live, only pictures of frames are made.
_LATER = {"REPORT": "html", "write_report": "html", "write_video": "video"}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
