# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""When a FITS image was exposed, by its header (FITS standard 4.0, section 9)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ofsat_ros.recordings.timing import NS, utc_ns

# In the order in which they are asked; EXPTIME is what nearly all software writes.
_EXPOSURES = ("EXPTIME", "EXPOSURE", "XPOSURE", "TELAPSE", "EXP_TIME", "ITIME", "EXPOINUS")
# By their comments some are not in s; EXPOINUS is in us by its name.
_UNITS = {r"\b(ms|msec|milli\w+)\b": 1e-3, r"\b(us|usec|\u00b5s|micro\w+)\b": 1e-6}
_CLOCKS = ("TIME-OBS", "UTSTART", "UTC-OBS", "UT-OBS", "UTC", "UT")
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")
_CLOCK = re.compile(r"\d\d:\d\d(:\d\d(\.\d*)?)?")
_UTC = ("", "UTC", "UT", "UT1", "GMT", "Z")
_LOCAL = ("LOCAL", "LT", "LCT", "LMT")
_SHIFT = "shift it with --stamp-offset-s (-3600 where clocks are an hour ahead of UTC)"
# What tells of the same instant may differ by so much: rounding, and begin or middle of it.
_ALIKE_NS = 600 * NS
_SCALES = {"ET": "tt", "TDT": "tt", "IAT": "tai"}
_MJD_1970 = 40587
_JD_MJD = 2400000.5
_DAY_NS = 86400 * NS


@dataclass(frozen=True)
class Exposure:
    """When one image, or the first of a cube, was exposed.

    Attributes
    ----------
    begin_ns, middle_ns, end_ns : int or None
        ns UTC; None: nothing tells it.
    seconds : float or None
        Length.
    """

    begin_ns: int | None = None
    middle_ns: int | None = None
    end_ns: int | None = None
    seconds: float | None = None

    @property
    def stamp_ns(self) -> int | None:
        """The middle, or the nearest to it that is known."""
        half_ns = round((self.seconds or 0) * NS / 2)
        if self.middle_ns is not None:
            return self.middle_ns
        if self.begin_ns is not None and self.end_ns is not None and not half_ns:
            return (self.begin_ns + self.end_ns) // 2
        if self.begin_ns is not None:
            return self.begin_ns + half_ns
        return None if self.end_ns is None else self.end_ns - half_ns

    def of_plane(self, plane: int, planes: int, step_s: float) -> int | None:
        """Return `stamp_ns` of an image of a cube, whose header tells of the whole of it."""
        if self.begin_ns is not None:
            first_ns = self.begin_ns + round((self.seconds or 0) * NS / 2)
            return first_ns + round(plane * step_s * NS)
        if self.middle_ns is not None:
            return self.middle_ns + round((plane - (planes - 1) / 2) * step_s * NS)
        if self.end_ns is not None:
            last_ns = self.end_ns - round((self.seconds or 0) * NS / 2)
            return last_ns - round((planes - 1 - plane) * step_s * NS)
        return None


def exposure(cards: Mapping[str, Any], exposure_s: float | None) -> tuple[Exposure, list[str]]:
    """Return when an image was exposed, and what was assumed.

    Parameters
    ----------
    cards : Mapping
        The header.
    exposure_s : float or None
        Length of the exposure, where the header has none.
    """
    notes: list[str] = []
    seconds = next(_seconds(cards), exposure_s)
    scale = str(cards.get("TIMESYS", "")).strip().upper()
    comment = str(cards.get("DATE-OBS/", ""))
    if scale in _LOCAL or (
        re.search(r"\blocal\b", comment, re.I) and not re.search(r"\bUTC?\b|\bGMT\b", comment)
    ):
        notes.append(f"by the headers DATE-OBS is local time; it is taken for UTC: {_SHIFT}")
        scale = ""
    meaning = _meaning(cards)
    parts = {"beg": ["BEG"], "avg": ["AVG"], "end": ["END"]}
    parts[meaning].append("OBS")
    if meaning != "beg":
        notes.append(
            "the comment of DATE-OBS says that it is the exposures'"
            f" {'middle' if meaning == 'avg' else 'end'}"
        )
    found = {}
    for part, names in parts.items():
        for text in (each for name in names for each in _instants(cards, name)):
            try:
                found[part] = _ns(text, scale)
                break
            except ValueError as error:
                notes.append(f"a header's time makes no sense: {error}")
    notes += _contradiction(cards, found.get("avg", found.get(meaning)), scale, seconds)
    when = Exposure(found.get("beg"), found.get("avg"), found.get("end"), seconds)
    if scale == "UT1":
        notes.append("times in UT1 are taken for UTC; they differ by less than 0.9 s")
    if when.middle_ns is None and None in (when.seconds, when.begin_ns):
        if when.begin_ns is not None and when.end_ns is None:
            notes.append(
                "headers tell when exposures began, but not how long they were: stamps are of"
                " their begin; --exposure would give their middle"
            )
    elif when.middle_ns is None:
        notes.append(
            "stamps are the middle of the exposures: the headers' times are taken for their"
            " begin, as the FITS standard has it, and half of the exposure is added"
        )
    return when, notes


def step_s(
    cards: Mapping[str, Any], fps: float | None, seconds: float | None
) -> tuple[float | None, str]:
    """Return the time from one image of a cube to the next, s or None, and what was assumed."""
    if fps:
        return 1 / fps, ""
    axis = _positive(cards.get("CDELT3")) if "TIM" in str(cards.get("CTYPE3", "")) else None
    if axis and str(cards.get("CUNIT3", "s")).strip().lower() in ("s", ""):
        return axis, ""
    cycle = _positive(cards.get("KCT"))  # "kinetic cycle time"
    if cycle or not seconds:
        return cycle, ""
    return seconds, (
        f"images of cubes are taken to follow each other without a gap, every {seconds:g} s:"
        " if not, give the rate, as in --fps 2"
    )


def _seconds(cards: Mapping[str, Any]) -> Iterator[float]:
    """Yield what the header tells of the exposure's length, s, the best first."""
    for name in _EXPOSURES:
        value = _positive(cards.get(name))
        comment = "us" if name == "EXPOINUS" else str(cards.get(f"{name}/", "")).lower()
        for pattern, unit in _UNITS.items():
            value = value * unit if value and re.search(pattern, comment) else value
        if value:
            yield value


def _contradiction(
    cards: Mapping[str, Any], used_ns: int | None, scale: str, seconds: float | None
) -> list[str]:
    """Say so if the header's times are apart by what could be a time zone."""
    for name in ("DATE-OBS", "MJD-OBS", "JD", "DATE-AVG"):
        part = name.partition("-")[2] or "OBS"
        told = [text for text in _instants({name: cards.get(name, "")}, part) if "T" in text]
        try:
            away_ns = used_ns - _ns(told[0], scale) if told and used_ns is not None else 0
        except ValueError:
            continue
        if abs(away_ns) > _ALIKE_NS + (seconds or 0) * NS:
            away_s = 900 * round(away_ns / (900 * NS))
            apart = f"{abs(away_s) / 3600:g} h {'later' if away_ns > 0 else 'earlier'}"
            return [
                f"the headers contradict themselves: the time that is used is {apart} than {name};"
                f" if it is local time, shift it with --stamp-offset-s {-away_s}"
            ]
    return []


def _meaning(cards: Mapping[str, Any]) -> str:
    """Return what DATE-OBS tells: the standard's begin, unless its comment says otherwise."""
    comment = str(cards.get("DATE-OBS/", "")).lower()
    if re.search(r"start|begin", comment):
        return "beg"
    if re.search(r"\bmid|\bcent(er|re)\b", comment):
        return "avg"
    return "end" if re.search(r"\bend\b", comment) else "beg"


def _instants(cards: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield what the header tells of an instant, as ISO 8601, the best first."""
    text = str(cards.get(f"DATE-{name}", cards.get(f"DATE_{name}", ""))).strip()
    if old := _OLD_DATE.fullmatch(text):
        day, month, year = old.groups()
        text = f"19{year}-{month}-{day}"
    if _DATE.fullmatch(text):
        clocks = [str(cards.get(name, "")).strip() for name in _CLOCKS]
        text = next((f"{text}T{each}" for each in clocks if _CLOCK.fullmatch(each)), "")
    if text:
        yield text.replace(" ", "T")
    days = _positive(cards.get(f"MJD-{name}"))
    julian = _positive(cards.get("JD")) if name == "OBS" else None
    if days is None and julian is not None:
        days = julian - _JD_MJD
    if days is not None:
        ns = round((days - _MJD_1970) * _DAY_NS)
        if abs(ns) < 2**62:
            yield str(np.datetime64(ns, "ns"))


def _ns(text: str, scale: str) -> int:
    """Return ns UTC of an ISO 8601 time in a time scale."""
    if scale in _UTC:
        return utc_ns(text)
    text = text.removesuffix("Z")
    date, _, clock = text.partition("T")
    if not (_DATE.fullmatch(date) and _CLOCK.fullmatch(clock)):
        raise ValueError(f"{text!r} is no date and time")
    return utc_ns(_to_utc(text, scale))


def _to_utc(text: str, scale: str) -> str:
    from astropy.time import Time, TimeDelta

    try:
        if scale == "GPS":  # which goes with TAI, 19 s behind it
            time = Time(text, format="isot", scale="tai") + TimeDelta(19, format="sec")
        else:
            time = Time(text, format="isot", scale=_SCALES.get(scale, scale.lower()))
        return str(Time(time.utc, precision=9).isot)
    except Exception as error:  # the library's own errors, and those of erfa below it
        raise ValueError(f"TIMESYS is {scale!r}: {error}") from error


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if 0 < number < 1e12 else None
