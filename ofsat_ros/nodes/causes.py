# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What is said in the log of a stream of messages: each cause once, not each message.

A camera that sends nonsense does so thirty times a second, all night.  ``/diagnostics`` shows what
is wrong at any moment; the log tells when it began, and when it was over.
"""

from __future__ import annotations

import re
import time
from typing import Any

# A cause that comes and goes is told of again after so long, s.
_AGAIN_AFTER_S = 60.0
# Messages begin with what is wrong; numbers, quotations and remedies follow.
_KIND = re.compile(r"[^\d'\":;(]*")


class Causes:
    """Tells what of a stream of messages is new in the log; for use by one thread."""

    def __init__(self) -> None:
        self._present = ""
        self._count = 0
        self._said = False
        self._said_at_s: dict[str, float] = {}

    def wrong(self, why: str) -> bool:
        """Take note of a bad message; return whether to say why.

        What stands in `why` before its first number or quotation is the cause: it is said when it
        begins, and not again while it lasts; if it comes back soon, only after a minute.
        """
        cause = _KIND.match(why)[0]  # type: ignore[index]
        self._count += 1
        if cause == self._present:
            return False
        self._present = cause
        now_s = time.monotonic()
        if now_s - self._said_at_s.get(cause, float("-inf")) < _AGAIN_AFTER_S:
            return False
        self._said_at_s[cause] = now_s
        self._said = True
        return True

    def right(self) -> int:
        """Take note of a good message; return how many bad ones it ends, 0 if none was told of."""
        told = self._count if self._said else 0
        self._present, self._count, self._said = "", 0, False
        return told


def say_left_out(logger: Any, causes: Causes, topic: str, error: Exception) -> None:
    """Log that a message on a detector's topic is of no use, whoever has published it."""
    if causes.wrong(str(error)):
        logger.warning(f"a message on {topic} is left out, which is not a detector's: {error}")
