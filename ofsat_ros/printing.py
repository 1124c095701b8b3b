# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Text that others wrote, on its way to a terminal.

Names of topics and of files, headers and diagnostics come from whoever recorded or sent them, and
a terminal obeys what stands in them: it would be cleared, coloured, or retitled.
"""

from __future__ import annotations

_WRITTEN_OUT = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0))}


def printable(text: str) -> str:
    r"""Return a text in one line, with control characters as ``\x1b`` and the like."""
    return text.translate(_WRITTEN_OUT)
