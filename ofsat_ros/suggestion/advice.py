# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""From what was measured to parameters, each with its reason.

The rules are measured on simulated scenes with another PSF, rate or sensor each (docs/optics.md
has the figures): one is here only if its parameter found more RSOs there, or fewer false ones.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ofsat_ros.parameters import Parameters
from ofsat_ros.suggestion.measurement import Measurement

# Smoothing by the geometric mean of this and the stars' sigma found most: wider lowers the noise,
# but blurs what moves slowly.  Up to a sigma of 1.75 px it gains nothing over the default.
_SHARP_PX, _SUITED_PX, _WIDEST_SMOOTHING_PX = 1.2, 1.75, 2.2
# Below, the pixels of a star look like defects; up to so many real ones are worth it.
_SHARP_FWHM_PX, _FEW_HOT_PIXELS = 1.45, 10
_FEW_OBJECTS, _LOWER_THRESHOLD = 20, 3.5
# What stands still over the ground, and what passes overhead at 400 km: against the stars, "/s.
_SLOW_ARCSEC_S, _FAST_ARCSEC_S = 15.0, 4000.0
# An RSO that moves by so much over the history is found; more frames cost memory and time.
_MOVED_PX, _MOST_FRAMES = 5.0, 30
# A speed that is higher by less is hardly ever met.
_WORTH_IT = 1.25
# An RSO must be in the image three times.
_SIGHTS = 3
_WIDE_FWHM_PX, _BINNED_FWHM_PX = 6.0, 2.5
_LONG_STREAK_PX = 40.0
_FEWEST_STARS = 5


@dataclass(frozen=True)
class Proposal:
    """A parameter's value and why; `default` is what it is without it."""

    name: str
    value: float | int | str
    default: float | int | str
    reason: str


@dataclass(frozen=True)
class Suggestion:
    """What suits a recording.

    Attributes
    ----------
    measured : Measurement
    proposals : tuple of Proposal
        Parameters that were thought about, those that stay as they are included.
    notes : tuple of str
        What the observer can do at the camera, and what was not known.
    """

    measured: Measurement
    proposals: tuple[Proposal, ...]
    notes: tuple[str, ...]

    @property
    def changes(self) -> dict[str, float | int | str]:
        """Parameters that differ from the defaults, and their values."""
        return {p.name: p.value for p in self.proposals if p.value != p.default}

    def as_dict(self) -> dict[str, Any]:
        """Return all of it for JSON; what is not known is None."""
        measured = dataclasses.asdict(self.measured) | {"fwhm_px": self.measured.fwhm_px}
        return {
            "measured": {
                name: None if isinstance(value, float) and not math.isfinite(value) else value
                for name, value in measured.items()
            },
            "proposals": [dataclasses.asdict(proposal) for proposal in self.proposals],
            "changes": self.changes,
            "notes": list(self.notes),
        }


def suggest(measured: Measurement) -> Suggestion:
    """Propose parameters that suit what was measured.

    Parameters
    ----------
    measured : Measurement
        As from `measure`.

    Returns
    -------
    Suggestion
    """
    defaults, proposals = Parameters(), []
    for name, rule in _RULES.items():
        default = getattr(defaults, name)
        value, reason = rule(measured, default)
        proposals.append(Proposal(name, value, default, reason))
    return Suggestion(measured, tuple(proposals), tuple(_notes(measured)))


def _smoothing(m: Measurement, default: float) -> tuple[float, str]:
    if not math.isfinite(m.psf_sigma_px):
        return default, "the stars' width is not known: too few bright ones"
    stars = f"stars are {m.fwhm_px:.1f} px wide (FWHM)"
    if m.psf_sigma_px < _SUITED_PX:
        return default, f"{stars}, which it suits"
    best = min(math.sqrt(_SHARP_PX * m.psf_sigma_px), _WIDEST_SMOOTHING_PX)
    return round(best, 1), f"{stars}: so smoothed they stand out most from the noise"


def _threshold(m: Measurement, default: float) -> tuple[float, str]:
    objects = f"{m.objects:.0f} objects a frame"
    if m.objects < _FEW_OBJECTS:
        return (
            _LOWER_THRESHOLD,
            f"{objects} are few: fainter stars help to know the field's motion",
        )
    return default, f"{objects} show the field's motion; RSOs fainter than it are found anyway"


def _window(m: Measurement, default: int) -> tuple[int, str]:
    return default, "it grows with a streak by itself, and RSOs are not found by it"


def _hot_pixels(m: Measurement, default: str) -> tuple[str, str]:
    if not m.fwhm_px < _SHARP_FWHM_PX:
        return default, f"there is none narrower than {_SHARP_FWHM_PX:g} px among the stars"
    stars = f"stars of {m.fwhm_px:.1f} px (FWHM) look like defects"
    if m.hot_pixels is None:
        return default, f"{stars}; whether there are defects is seen only while the field moves"
    if m.hot_pixels > _FEW_HOT_PIXELS:
        return default, f"{stars}, but {m.hot_pixels} pixels shine in every frame"
    return "keep", f"{stars}, and only {m.hot_pixels} pixels shine in every frame"


def _history(m: Measurement, default: int) -> tuple[int, str]:
    step = _SLOW_ARCSEC_S * m.interval_s / m.pixel_scale_arcsec
    if not step > 0:
        return default, f"the slowest motion is not known{_why_no_scale(m)}"
    slow = f"what stands still over the ground moves {step:.2g} px a frame against the stars"
    wanted = math.ceil(_MOVED_PX / step)
    if wanted <= default:
        return default, slow
    frames = min(wanted, _MOST_FRAMES)
    return frames, f"{slow}, {step * frames:.2g} px in {frames} frames"


def _max_speed(m: Measurement, default: float) -> tuple[float, str]:
    step = _FAST_ARCSEC_S * m.interval_s / m.pixel_scale_arcsec
    if not step > 0:
        return default, f"the fastest motion is not known{_why_no_scale(m)}"
    fast = f"what passes overhead at 400 km moves {step:.0f} px a frame"
    seen = min(m.width, m.height) / _SIGHTS
    if step > seen:
        fast += f"; faster than {seen:.0f} px, it is in too few images"
    wanted = float(math.ceil(min(step, seen)))
    return (wanted if wanted > _WORTH_IT * default else default), fast


def _max_gap(m: Measurement, default: float) -> tuple[float, str]:
    if not m.interval_s > 0:
        return default, "the time between frames is not known"
    every = f"a frame comes every {m.interval_s:.4g} s"
    if 2 * m.interval_s <= default:
        return default, every
    return float(math.ceil(3 * m.interval_s)), f"{every}: one that is missing shall not end all"


def _why_no_scale(m: Measurement) -> str:
    if not m.interval_s > 0:
        return ": nor is the time between frames"
    return ": give --pixel-scale"


_RULES: dict[str, Callable[[Measurement, Any], tuple[float | int | str, str]]] = {
    "smoothing_sigma_px": _smoothing,
    "threshold_sigmas": _threshold,
    "window_px": _window,
    "hot_pixels": _hot_pixels,
    "history_frames": _history,
    "max_speed_px": _max_speed,
    "max_gap_s": _max_gap,
}


def _notes(m: Measurement) -> Iterator[str]:
    """What no parameter mends."""
    if m.fwhm_px < _SHARP_FWHM_PX:
        yield (
            f"stars are sharper ({m.fwhm_px:.1f} px) than pixels can show: defocus a little, to a"
            " FWHM of 2 px"
        )
    if m.fwhm_px > _WIDE_FWHM_PX:
        bins = round(m.fwhm_px / _BINNED_FWHM_PX)
        yield (
            f"stars are {m.fwhm_px:.1f} px wide: focus, or bin {bins}x{bins} in the camera, which"
            " finds fainter RSOs and is faster"
        )
    if m.saturated_share > 0.5:
        yield "more than half of the bright stars are saturated: expose shorter, or lower the gain"
    if m.whole_numbers and m.pixel_noise < 1:
        yield (
            f"a pixel's noise is {m.pixel_noise:.2g} DN: below 1 DN faint light is rounded away;"
            " raise the gain, record more bits, or raise the offset if the sky is 0"
        )
    if m.objects < _FEWEST_STARS:
        yield f"{m.objects:.0f} objects a frame are too few: expose longer, or look where more are"
    if m.streak_px > _LONG_STREAK_PX:
        yield (
            f"stars streak over {m.streak_px:.0f} px: shorter exposures lose less of what moves"
            " otherwise"
        )
    if m.field_px > min(m.width, m.height) / 4:
        yield (
            f"the field moves {m.field_px:.0f} px a frame, and stars leave the image within four:"
            " shorten the interval"
        )
    if m.longest_gap_s > 1.5 * m.interval_s:
        yield f"frames are missing: up to {m.longest_gap_s:.4g} s lie between two"
    if m.seconds > m.interval_s > 0:
        yield (
            f"live, this machine would drop frames: it takes {m.seconds:.2g} s for one, and they"
            f" come every {m.interval_s:.2g} s"
        )
