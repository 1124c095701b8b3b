# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Nights, from noon to noon."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Self

_NS = 1_000_000_000
_DAY_NS = 86400 * _NS


@dataclass(frozen=True, order=True)
class Night:
    """A night: from one noon to the next, by the Sun's mean motion at a longitude.

    Attributes
    ----------
    evening : date
        The day on whose noon it begins.
    longitude_deg : float
        East positive; 0: noon UTC.
    """

    evening: date
    longitude_deg: float = 0.0

    @classmethod
    def of(cls, stamp_ns: int, longitude_deg: float = 0.0) -> Self:
        """Return the night in which an instant (ns UTC) lies."""
        noons = (int(stamp_ns) - _first_noon_ns(longitude_deg)) // _DAY_NS
        return cls(date(1970, 1, 1) + timedelta(days=noons), longitude_deg)

    @classmethod
    def parse(cls, text: str, longitude_deg: float = 0.0) -> Self:
        """Read ``YYYY-MM-DD``, the evening's date.

        Raises
        ------
        ValueError
            If the text is anything else.
        """
        try:
            return cls(
                datetime.strptime(text, "%Y-%m-%d").replace(tzinfo=UTC).date(), longitude_deg
            )
        except ValueError:
            raise ValueError(
                f"a night is the date of its evening, as 2026-03-01, not {text!r}"
            ) from None

    @property
    def first_ns(self) -> int:
        """Its noon, ns UTC."""
        return (
            _first_noon_ns(self.longitude_deg) + (self.evening - date(1970, 1, 1)).days * _DAY_NS
        )

    @property
    def end_ns(self) -> int:
        """The next noon, ns UTC, which is not its own any more."""
        return self.first_ns + _DAY_NS

    def __str__(self) -> str:
        return self.evening.isoformat()


def _first_noon_ns(longitude_deg: float) -> int:
    """Noon of 1970-01-01 at a longitude."""
    east = (longitude_deg + 180) % 360 - 180
    return round((0.5 - east / 360) * 86400) * _NS
