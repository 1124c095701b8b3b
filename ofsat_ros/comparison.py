# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Two frames of a sequence compared: the flow between them, and the motion of the star field.

Stands between the objects of a frame and what the pipeline keeps of many: it leads the optical
flow to where the field went and asks whether what it found is the field's motion, or chance.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow import Flow, FlowInput, flow_engine
from ofsat_ros.parameters import Parameters
from ofsat_ros.star_field import StarFieldMotion, estimate_motion, vote_shift

Array = NDArray[np.float64]

# Images that were preprocessed differently cannot be compared.
_PREPROCESSING = [p.name for p in Parameters.describe() if p.stage == "preprocessing"]
# What of an object noise and clouds hardly show.
_CLEAR_SNR = 7.0
# So many clear objects are a star field that another frame of it would show, too; and so many
# would show how it moves, whatever else is among them.
_FEW_STARS, _MANY_STARS = 3, 10
# A place on an object is its place if it is as near as this to its centroid, px and in lengths.
_ON_PX, _ON_SHARE = 3.0, 0.25
# A track is as near as this to where it is expected if the field goes on as it did, px.
_NEAR_PX = 10.0
# By a motion that is less sure than this, px, stars pass for what moves; hundredths are usual.
_SUREST_PX = 0.25
# A lone star goes on as the field did within this, and so many of its sigmas, px.
_SAME_PX, _SAME_SIGMAS = 1.0, 3.0


@dataclass(frozen=True)
class Seen:
    """A frame that others are compared with.

    Attributes
    ----------
    stamp_ns : int
        Its stamp, ns UTC.
    dtype : numpy.dtype
        Of its image.
    parameters : Parameters
        Those that it was processed with.
    objects : (N,) OBJECT_DTYPE
        Its objects.
    flow_input : FlowInput
        The same for the flow engines.
    strays : (K,) intp
        Rows of objects that surely do not move with the stars.
    """

    stamp_ns: int
    dtype: np.dtype
    parameters: Parameters
    objects: NDArray[np.void]
    flow_input: FlowInput
    strays: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))

    @property
    def all(self) -> NDArray[np.bool_]:
        """All objects, (N,)."""
        return np.ones(len(self.objects), bool)

    @property
    def clear(self) -> NDArray[np.bool_]:
        """Which objects are clear ones, (N,)."""
        return self.objects["snr"] >= _CLEAR_SNR

    def shows_stars(self, known: Array | None = None) -> bool:
        """Whether it has enough clear objects, beside known ones (K, 2) px, to call some stars."""
        return self.stars_beside(known) >= _FEW_STARS

    def stars_beside(self, known: Array | None = None) -> int:
        """Count the clear objects away from known ones (K, 2) px."""
        if known is None or not len(known):
            return int(self.clear.sum())
        far = ~is_near(self.flow_input.xy, known, self.objects["length"])
        return int(np.count_nonzero(self.clear & far))

    def leads_astray(self, flow: Flow) -> NDArray[np.bool_]:
        """Which vectors of a flow from this frame come from one of its strays, (N,).

        Valid or not: a stray whose vector is none is still one.
        """
        stray = np.zeros(len(flow), bool)
        if len(self.strays):
            start = flow.position - flow.displacement
            rows = np.flatnonzero(self.flow_input.contains(start))
            stray[rows] = np.isin(self.flow_input.object_at(start[rows]), self.strays)
        return stray

    def shows_as_much_as(self, other: Seen | None) -> bool:
        """Whether it has no fewer clear objects than another frame."""
        return other is None or bool(self.clear.sum() >= other.clear.sum())


def why_not_comparable(before: Seen, now: Seen) -> str:
    """Say why two frames cannot be compared; empty if they can."""
    old, new = before.flow_input.smoothed.shape, now.flow_input.smoothed.shape
    if old != new:
        return f"the image's size changed from {old[1]}x{old[0]} to {new[1]}x{new[0]}"
    if before.dtype != now.dtype:
        return f"the image's type changed from {before.dtype} to {now.dtype}"
    dt_s, most_s = (now.stamp_ns - before.stamp_ns) / 1e9, now.parameters.max_gap_s
    if dt_s > most_s:
        return f"a gap of {dt_s:g} s is longer than max_gap_s = {most_s:g} s"
    changed = [
        name
        for name in _PREPROCESSING
        if getattr(before.parameters, name) != getattr(now.parameters, name)
    ]
    return f"{' and '.join(changed)} changed" if changed else ""


def measure_flow(
    before: Seen, now: Seen, expected: StarFieldMotion | None, parameters: Parameters
) -> Flow:
    """Measure the flow of a frame's objects, from where the star field most likely was.

    Parameters
    ----------
    before, now : Seen
        Two frames of the same size.
    expected : StarFieldMotion or None
        Motion of the field between them if it goes on as it did.
    parameters : Parameters
    """
    guesses = np.zeros((1, 2))
    if parameters.first_guess == "field":
        shift = vote_shift(
            before.flow_input.xy, before.objects["flux"], now.flow_input.xy, now.objects["flux"]
        )
        if shift is None and expected is not None:
            # Too few votes to tell from chance: a mount most likely goes on as it did.
            shift = expected.displacement
        if shift is not None:
            # No motion comes second: in rate tracking the RSOs stand still.
            guesses = np.stack([shift, np.zeros(2)])
    return flow_engine(parameters).measure(before.flow_input, now.flow_input, guesses)


def find_motion(
    flow: Flow,
    before: Seen,
    now: Seen,
    expected: StarFieldMotion | None,
    doubted: StarFieldMotion | None,
    parameters: Parameters,
) -> tuple[StarFieldMotion | None, bool]:
    """Find the field's motion in the flow.

    See `measure_flow` for the parameters.

    Parameters
    ----------
    doubted : StarFieldMotion or None
        Motion between the frames if what frames before showed, and may well have been chance,
        goes on: where stars are few, seen twice is believed.

    Returns
    -------
    motion : StarFieldMotion or None
        The motion that most vectors share; `inliers` are rows of the flow.
    believed : bool
        Whether it is more than chance shows.
    """
    valid = flow.valid
    if parameters.rso_test == "history":
        valid = valid & ~before.leads_astray(flow)
    motion = _motion_of(flow, valid, now, expected, parameters)
    if motion is None and expected is not None and len(before.strays):
        # Where the others are known to be no stars, one that goes on as they did tells enough.
        off = np.hypot(*(flow.displacement - expected.displacement_at(flow.position)).T)
        valid = valid & (off <= _SAME_PX + _SAME_SIGMAS * flow.sigma.mean(axis=1))
        motion = _motion_of(flow, valid, now, expected, parameters)
    if motion is None:
        return None, False
    # As published, the mean is never doubted.
    believed = parameters.star_field_model == "mean" or _is_shared(motion, before, now, expected)
    if not believed and expected is None and doubted is not None and motion.is_about(doubted):
        believed = _is_shared(motion, before, now, doubted)
    inliers = np.zeros(len(flow), bool)
    inliers[valid] = motion.inliers
    return motion.with_inliers(inliers), believed


def _motion_of(
    flow: Flow,
    rows: NDArray[np.bool_],
    now: Seen,
    expected: StarFieldMotion | None,
    parameters: Parameters,
) -> StarFieldMotion | None:
    return estimate_motion(
        flow.position[rows],
        flow.displacement[rows],
        flow.sigma[rows],
        flow.speed_mean[rows],
        now.flow_input.smoothed.shape,
        parameters.star_field_model,
        parameters.outlier_sigmas,
        expected,
    )


def why_not_placed(motion: StarFieldMotion, expected: StarFieldMotion | None) -> str:
    """Say why frames that a motion of the field leads to have no place beside those before.

    Empty if they have.  While a mount slews, its rate changes within an exposure; stars are
    streaks then that no motion fits, and would seem to have moved against each other.

    Parameters
    ----------
    motion : StarFieldMotion
        From the frame before.
    expected : StarFieldMotion or None
        The same if it goes on as before; None if that is not known.
    """
    sigma_px = float(np.sqrt(np.diag(motion.covariance)[:2]).max())
    if expected is None or motion.is_about(expected) or sigma_px <= _SUREST_PX:
        return ""
    return f"the star field's motion has changed, and is known to {sigma_px:.1f} px only"


def why_another_field(before: Seen, now: Seen, known: Array, moved: bool) -> str:
    """Say why a frame with no motion from the one before shows another star field.

    Empty if it shows too few stars to be one: they are behind clouds, or there are none.  Or if
    stars are few and none has shown how the field moves: they may well be the same.

    Parameters
    ----------
    before, now : Seen
        The frames.
    known : (K, 2) float64
        Where tracks are expected, which are no stars, px.
    moved : bool
        Whether a motion of the field is known.
    """
    stars = now.stars_beside(known)
    if stars < _FEW_STARS:
        return ""
    if not len(before.objects) or (not before.shows_stars() and stars >= _MANY_STARS):
        return "the frame before showed no star field"
    if stars < _MANY_STARS and not (moved and before.shows_stars()):
        return ""
    return (
        f"the star field jumped: no motion leads from the {len(before.objects)} objects of the"
        f" frame before to the {len(now.objects)} of this one"
    )


def is_near(xy: Array, points: Array, beyond_px: Array | float = 0.0) -> NDArray[np.bool_]:
    """Which places (N, 2) px are near one of the points (K, 2), or beyond that by so much, px."""
    near = np.zeros(len(xy), bool)
    for point in points:
        near |= np.hypot(*(xy - point).T) <= _NEAR_PX + beyond_px
    return near


def _is_shared(
    motion: StarFieldMotion, before: Seen, now: Seen, expected: StarFieldMotion | None
) -> bool:
    """Whether a motion carries objects of one frame onto those of the other, and not by chance.

    The clear ones count by themselves, too: where stars are few, noise outnumbers them.
    """
    for one, other in ((before.all, now.all), (before.clear, now.clear)):
        objects = int(np.count_nonzero(one)), int(np.count_nonzero(other))
        # Clouds may hide from either frame what the other shows.
        ways = (now, other, before, motion, -1), (before, one, now, motion, 1)
        if any(motion.is_credible(expected, objects, *_carried(*way)) for way in ways):
            return True
    return False


def _carried(
    start: Seen, rows: NDArray[np.bool_], end: Seen, motion: StarFieldMotion, times: int
) -> tuple[int, int, float]:
    """How many objects a motion carries into another frame, onto objects, and their part of it."""
    there = end.flow_input
    xy = start.flow_input.xy[rows]
    place = xy + times * motion.displacement_at(xy)
    place = place[there.contains(place)]
    carried = len(place)
    row = there.object_at(place)
    place, row = place[row >= 0], row[row >= 0]
    # Long streaks lie on each other wherever along themselves they are.
    off = np.hypot(*(place - there.xy[row]).T)
    found = int(np.count_nonzero(off <= _ON_PX + _ON_SHARE * there.length[row]))
    return carried, found, there.regions.pixels.size / there.smoothed.size
