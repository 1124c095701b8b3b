# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a report says in words: the sentence on top, and numbers as people write them."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ofsat_ros.parameters import TABLES, Description, ParameterError, Parameters
from ofsat_ros.recordings import utc_text
from ofsat_ros.report.findings import Findings

# Slower than this, px per frame, stars are said to stand still.
_STILL_PX = 0.05
_MINUS, _THIN = "\u2212", "\u202f"


def number(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits; a dash if it is unknown."""
    if not math.isfinite(value):
        return "\u2013"
    places = 0
    if value:
        places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:,.{places}f}".replace("-", _MINUS).replace(",", _THIN)


def count(how_many: int, what: str) -> str:
    """Write a count and what is counted."""
    return f"{how_many:,} {what}{'s' * (how_many != 1)}".replace(",", _THIN)


def instant(stamp_ns: int, *, day: bool = True) -> str:
    """Write a stamp as a date and a time, UTC, to the ms."""
    seconds, ns = divmod(int(stamp_ns), 1_000_000_000)
    when = datetime.fromtimestamp(seconds, UTC)
    return f"{when:{'%Y-%m-%d ' if day else ''}%H:%M:%S}.{ns // 1_000_000:03d}"


def duration(seconds: float) -> str:
    """Write a time span."""
    if seconds < 120:
        return f"{number(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def headline(findings: Findings) -> str:
    """Say how many RSOs there are."""
    found = len(findings.tracks)
    frames = count(len(findings.frames), "frame")
    return f"{count(found, 'RSO') if found else 'No RSO'} in {frames}"


def lead(findings: Findings) -> str:
    """Say what matters most about them, or why there is none."""
    if not len(findings.frames):
        return "No frame could be processed."
    words = _brightest(findings) if findings.tracks else _why_none(findings)
    if sky := _sky(findings):
        words += f" {sky}"
    if findings.run.get("stopped"):
        words += " The run was stopped before the recording's end."
    return words


def _brightest(findings: Findings) -> str:
    track = max(findings.tracks, key=lambda one: np.nan_to_num(one.flux))
    frames = len(findings.frames)
    seen = len(np.unique(track.rows["frame"]))
    often = "every frame" if seen == frames else count(seen, "frame")
    if seen == frames - 1:
        often = "all frames but one"
    name = f"The brightest, #{track.number}," if len(findings.tracks) > 1 else f"#{track.number}"
    speed = f"{number(track.speed * findings.step_s, 2)} px a frame"
    if math.isfinite(track.arcsec_per_s):
        speed += f" ({number(track.arcsec_per_s)}\u2033/s)"
    return (
        f"{name} has SNR {number(track.snr, 2)}, moves {speed} against the stars and is seen in"
        f" {often}."
    )


def _why_none(findings: Findings) -> str:
    frames = findings.frames
    blind = int(np.isnan(frames["dx_px"][1:]).sum())
    words = []
    if len(frames) == 1:
        return "A single frame shows no motion: three at least are needed, ten are good."
    if len(frames) == 2:
        words.append("An RSO is known as such in its third frame at the earliest: there are two.")
    if blind:
        words.append(
            f"The star field's motion was not found in {blind} of {count(len(frames), 'frame')}."
        )
    notes = Counter(note for note in frames["note"][1:] if note)
    last = frames["note"][-1] or (notes.most_common(1)[0][0] if notes else "")
    if last:
        words.append(f"The last frame says: {last}.")
    return " ".join(words) or "Nothing moved other than the stars."


def _sky(findings: Findings) -> str:
    frames = findings.frames
    step = (
        float(np.nanmedian(np.hypot(frames["dx_px"], frames["dy_px"])))
        if _knows(frames)
        else math.nan
    )
    if not math.isfinite(step):
        return ""
    if step < _STILL_PX:
        return "The stars stand still on the sensor."
    followed = [track for track in findings.tracks if track.is_followed]
    drift = f"the stars drift {number(step, 2)} px a frame"
    if followed and len(followed) == len(findings.tracks):
        return f"The mount follows {'it' if len(followed) == 1 else 'them'}: {drift}."
    return f"{drift[0].upper()}{drift[1:]}."


def _knows(frames: Any) -> bool:
    return bool(np.isfinite(frames["dx_px"]).any())


def sexagesimal(ra_deg: float, dec_deg: float) -> str:
    """Write a direction as hours and degrees, ICRS; empty if it is unknown."""
    if not math.isfinite(ra_deg + dec_deg):
        return ""
    tenths = round((ra_deg % 360) / 15 * 36000) % 864000
    hours, tenths = divmod(tenths, 36000)
    seconds, sign = round(abs(dec_deg) * 3600), _MINUS if dec_deg < 0 else "+"
    ra = f"{hours:02d}h {tenths // 600:02d}m {tenths % 600 / 10:04.1f}s"
    dec = f"{seconds // 3600:02d}\u00b0 {seconds // 60 % 60:02d}\u2032 {seconds % 60:02d}\u2033"
    return f"{ra} {sign}{dec}"


def parameters_used(run: dict[str, Any]) -> list[tuple[Description, Any, bool]]:
    """Return each parameter with the value used, and whether that is not the default."""
    used = run.get("parameters") or {}
    known = {about.name: about for table in TABLES for about in table.describe()}
    return [
        (known[name], value, value != known[name].default)
        for name, value in used.items()
        if name in known
    ]


def recordings(run: dict[str, Any]) -> list[str]:
    """Return the paths of what was processed; empty if that is not told."""
    told = run.get("recording") or []
    return [told] if isinstance(told, str) else list(told)


def command_line(run: dict[str, Any]) -> str:
    """Return the command that gives these results again, with this version's presets."""
    options = {name: run.get(name) for name in _SOURCE}
    preset = run.get("preset") or ""
    try:
        of_preset = Parameters.preset(preset).as_dict()
    except ParameterError:
        of_preset = {}
    if of_preset and of_preset != Parameters().as_dict():
        options["preset"] = preset
    for about, value, _ in parameters_used(run):
        if value != of_preset.get(about.name, about.default):
            options[about.name] = value
    words = process_words(recordings(run) or ["RECORDING"], options)
    return shlex.join([*words, "--live"] if run.get("live") else words)


# Options of `open_recording`, and those that the command line has other names for.
_SOURCE = ("topic", "camera_info_topic", "attitude_topic", "fps", "exposure_s", "start_ns")
_NAMES = {"exposure_s": "--exposure", "start_ns": "--start"}


def process_words(paths: Iterable[str | Path], options: Mapping[str, Any]) -> list[str]:
    """Return the words of the command that processes recordings.

    Parameters
    ----------
    paths : iterable of str or Path
    options : mapping of str to any
        By their names in Python; None or empty if not given.
    """
    words = ["ofsat", "process", *map(str, paths), "-o", "results"]
    for name, value in options.items():
        if value is None or value == "":
            continue
        if name == "start_ns":
            value = utc_text(value)
        elif isinstance(value, bool):
            value = f"{value}".lower()
        words += [_NAMES.get(name, f"--{name.replace('_', '-')}"), f"{value}"]
    return words
