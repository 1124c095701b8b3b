# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Lines in the IOD format, as observers of satellites send them to SeeSat-L.

Follows the IOD Observation Format Description (G. D. Lewis, 1998, clarified 2002): one direction
per line of fixed columns.  Of its formats for right ascension and declination this writes number
3, HHMMmmm+DDdddd, whose steps are the finest: 0.9 and 0.36 arcsec; the epoch is J2000, to which
ICRS is the same at this resolution.  What nobody has judged, the sky's condition and the flashing
of the object, stays blank.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import datetime, timedelta

import numpy as np

from ofsat_ros.parameters import ParameterError, TrackingDataParameters
from ofsat_ros.tracking_data.arcs import Arc
from ofsat_ros.tracking_data.tdm import magnitudes, utc

_FORMAT, _EPOCH = 3, 5
# Steps of the format, and the std that rounding to them adds.
_RA_PER_DEG, _DEC_PER_DEG = 60_000 / 15, 10_000
_ROUNDING_DEG = 1 / _RA_PER_DEG / math.sqrt(12)
_TIME_STEP_S = 0.001
# 25544, or 1998-067A, or both.
_NAME = re.compile(r"(?P<number>\d{1,5})?\s*((19|20)(?P<year>\d\d)-(?P<launch>\d{3}[A-Z]{1,3}))?")
# Of objects that have no number; the launches of a year are far fewer than 500.
_UNKNOWN_NUMBER, _UNKNOWN_LAUNCH, _UNKNOWN_PIECE = 90_000, 500, "UNK"
_MAG_PER_NOISE = 2.5 / math.log(10)
_WIDEST_MAG = 999  # tenths, as three digits hold them


def check_iod(parameters: TrackingDataParameters) -> None:
    """Raise ParameterError if the parameters do not do for this format."""
    if not re.fullmatch(r"\d{4}", parameters.station):
        raise ParameterError(
            "format iod wants the station's COSPAR number: station must be four digits, as 4171,"
            f" not {parameters.station!r} (9999 is used by who has none)"
        )


def iod_lines(arcs: Sequence[Arc], parameters: TrackingDataParameters) -> str:
    """Return the lines of all directions of all arcs.

    Parameters
    ----------
    arcs : sequence of Arc
    parameters : TrackingDataParameters

    Raises
    ------
    ParameterError
        If the station is no COSPAR number.
    """
    check_iod(parameters)
    time_sigma = _mx(max(parameters.time_sigma_s, _TIME_STEP_S))
    lines = []
    for arc in arcs:
        who = f"{_object(arc, parameters)} {parameters.station}  "
        magnitude = magnitudes(arc.rows, parameters.zero_point_mag)
        for row, mag in zip(arc.rows, magnitude.tolist(), strict=True):
            when = f"{_time(int(row['stamp_ns']))} {time_sigma}"
            where = f"{_FORMAT}{_EPOCH} {_position(row)} {_position_sigma(row)}"
            lines.append(f"{who} {when} {where}  {_brightness(mag, row)}".rstrip())
    return "\n".join(lines) + "\n"


def _object(arc: Arc, parameters: TrackingDataParameters) -> str:
    """Columns 1 to 15: number and international designation.

    An unknown object gets a number from 90000 on, and the year and 500 + day of the year of its
    observation for a launch, as the observers' usage is.
    """
    name = parameters.object_by_track.get(arc.label, "").strip()
    known = _NAME.fullmatch(name)
    if name and known:
        number = f"{int(known['number']):05d}" if known["number"] else ""
        designation = f"{known['year']} {known['launch']}" if known["year"] else ""
        return f"{number:5} {designation:9}"
    number = f"{_UNKNOWN_NUMBER + int(arc.label.partition('-')[0]) % 10_000}"
    first = utc(arc.first_ns)
    launch = _UNKNOWN_LAUNCH + first.timetuple().tm_yday
    return f"{number} {first:%y} {launch}{_UNKNOWN_PIECE}"


def _time(stamp_ns: int) -> str:
    """Columns 24 to 40: date and time to milliseconds."""
    when: datetime = utc(stamp_ns) + timedelta(microseconds=500)
    return f"{when:%Y%m%d%H%M%S}{when.microsecond // 1000:03d}"


def _position(row: np.void) -> str:
    """Columns 48 to 61: HHMMmmm+DDdddd."""
    ra = round(math.degrees(row["ra"]) % 360 * _RA_PER_DEG) % round(360 * _RA_PER_DEG)
    dec = round(math.degrees(row["dec"]) * _DEC_PER_DEG)
    hours, minutes = divmod(ra, 60_000)
    return f"{hours:02d}{minutes:05d}{'-' if dec < 0 else '+'}{abs(dec):06d}"


def _position_sigma(row: np.void) -> str:
    """Columns 63 to 64: std of the worse angle, that of the rounding included; deg."""
    sigma = max(row["sigma_ra"], row["sigma_dec"])
    return _mx(math.hypot(math.degrees(sigma), _ROUNDING_DEG)) if math.isfinite(sigma) else "  "


def _brightness(mag: float, row: np.void) -> str:
    """Columns 67 to 73: magnitude and its std, tenths without a point; none if they cannot."""
    if not math.isfinite(mag) or abs(round(10 * mag)) > _WIDEST_MAG:
        return ""
    sigma = _MAG_PER_NOISE / row["snr"] if row["snr"] > 0 else math.nan
    tenths = f"{min(99, math.ceil(10 * sigma)):02d}" if math.isfinite(sigma) else ""
    return f"{round(10 * mag):+04d} {tenths}"


def _mx(value: float) -> str:
    """A std as mantissa and exponent: M times 10 to the (X - 8), M from 1 to 9."""
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    x = int(exponent) + 8
    if x < 0:
        return "10"
    return f"{mantissa}{x}" if x <= 9 else "99"
