# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which tracks are wanted."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ofsat_ros.catalog.sphere import unit_vectors
from ofsat_ros.recordings import utc_text

Range = tuple[float, float]

# One condition: in words, as SQL, and what SQL needs for it.
Condition = tuple[str, str, tuple[Any, ...]]
# Caps are compared by cosines, which round: so much too large costs nothing.
_SLACK = 1e-9


@dataclass(frozen=True)
class Cone:
    """A round part of the sky.

    Attributes
    ----------
    ra_deg, dec_deg : float
        Its middle, ICRS.
    radius_deg : float

    Raises
    ------
    ValueError
        If it is not on the sky.
    """

    ra_deg: float
    dec_deg: float
    radius_deg: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.ra_deg) and -90 <= self.dec_deg <= 90):
            raise ValueError(
                "the middle of a cone is RA and DEC in degrees, the latter within -90 to 90, not"
                f" {self.ra_deg:g} {self.dec_deg:g}"
            )
        if not 0 <= self.radius_deg <= 180:
            raise ValueError(f"a cone's radius is 0 to 180 degrees, not {self.radius_deg:g}")

    def __str__(self) -> str:
        return f"{self.radius_deg:g} deg about {self.ra_deg:g} {self.dec_deg:g}"


@dataclass(frozen=True)
class Selection:
    """What tracks must be like; what is None doesn't matter, and what is unknown doesn't fit.

    Attributes
    ----------
    from_ns, to_ns : int or None
        Seen at or after, at or before; ns UTC.
    cone : Cone or None
        Their path crosses it: the great circles between the places where they were seen, so that
        what is fast, and jumps over a small cone, crosses it.
    rate_px_s : (float, float) or None
        Lowest and highest rate against the stars; either may be infinite, as below.
    rate_arcsec_s : (float, float) or None
    snr : (float, float) or None
    magnitude : (float, float) or None
        Instrumental: -2.5 log10 of the flux in DN.
    recording : str or None
        Part of a path of the recording, in any case.
    result : int or None
        A result's number in the catalogue.
    began : (int, int) or None
        The first frame of the recording is of this ns UTC or later, and before the other.
    """

    from_ns: int | None = None
    to_ns: int | None = None
    cone: Cone | None = None
    rate_px_s: Range | None = None
    rate_arcsec_s: Range | None = None
    snr: Range | None = None
    magnitude: Range | None = None
    recording: str | None = None
    result: int | None = None
    began: tuple[int, int] | None = None

    def conditions(self) -> Iterator[Condition]:
        """Yield what SQL can tell; of a cone, it can tell who does not come near."""
        if self.from_ns is not None:
            words = f"seen at {utc_text(self.from_ns)} or later"
            yield words, "tracks.last_stamp_ns >= ?", (self.from_ns,)
        if self.to_ns is not None:
            words = f"seen at {utc_text(self.to_ns)} or before"
            yield words, "tracks.first_stamp_ns <= ?", (self.to_ns,)
        if self.cone is not None:
            yield _near(self.cone)
        for name in ("rate_px_s", "rate_arcsec_s", "snr"):
            if (limits := getattr(self, name)) is not None:
                yield f"with {name} {_span(limits)}", f"tracks.{name} BETWEEN ? AND ?", limits
        if self.magnitude is not None:
            brightest, faintest = (_flux(value) for value in self.magnitude)
            words = f"with magnitude {_span(self.magnitude)}"
            yield words, "tracks.flux > 0 AND tracks.flux BETWEEN ? AND ?", (faintest, brightest)
        if self.recording is not None:
            words, wanted = f"in a recording of {self.recording!r}", self.recording.casefold()
            yield words, "instr(casefold(results.recording), ?)", (wanted,)
        if self.result is not None:
            yield f"in result {self.result}", "tracks.result = ?", (self.result,)
        if self.began is not None:
            began = "results.first_stamp_ns >= ? AND results.first_stamp_ns < ?"
            yield "of that night", began, self.began


def _span(limits: Range) -> str:
    low, high = (f"{limit:g}" for limit in limits)
    if math.isinf(limits[0]):
        return f"up to {high}"
    return f"from {low}" if math.isinf(limits[1]) else f"{low} to {high}"


def _near(cone: Cone) -> Condition:
    """Tracks whose cap meets the cone: their middles are nearer than the sum of both radii."""
    radius = math.radians(cone.radius_deg)
    middle = unit_vectors(cone.ra_deg, cone.dec_deg).tolist()
    words = f"within {cone}"
    # Sums of more than half a turn have a larger cosine again: then the cap's sine is small.
    sql = (
        "cap_x IS NOT NULL AND (cap_x * ? + cap_y * ? + cap_z * ? >= cap_cos * ? - cap_sin * ? - ?"
        " OR cap_cos <= ?)"
    )
    return words, sql, (*middle, math.cos(radius), math.sin(radius), _SLACK, -math.cos(radius))


def _flux(magnitude: float) -> float:
    if math.isinf(magnitude):
        return 0.0 if magnitude > 0 else math.inf
    return float(10.0 ** min(-0.4 * magnitude, 300.0))
