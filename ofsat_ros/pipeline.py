"""The pipeline: the order of the stages, and what is kept of the frames before.

The one place that knows all stages.  Live nodes and offline commands feed it one image at a time
and get a `FrameResult`; what is different between them lies outside.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import (
    DETECTION_DTYPE,
    detect,
    find_drifting,
    find_spots,
    refine,
    spot_near,
)
from ofsat_ros.history import History, PastFrame
from ofsat_ros.objects import OBJECT_DTYPE, find_objects
from ofsat_ros.optical_flow import Flow, FlowInput, flow_engine
from ofsat_ros.parameters import Parameters
from ofsat_ros.pixels import Regions
from ofsat_ros.preprocessing import Preprocessed, SensorMemory, preprocess
from ofsat_ros.star_field import StarFieldMotion, estimate_motion, vote_shift
from ofsat_ros.tracking import TRACK_DTYPE, Settled, Tracker

_SMALLEST_SIDE = 16
_DTYPES = ("uint8", "uint16", "float32")
# Where a track is expected, a closer look finds what is a spot of this many sigmas, this near, px.
_CLOSER_SIGMAS, _CLOSER_PX = 2.0, 2
# Frames in a row over which the field's motion is taken to go on when too few stars show it.
_BLIND_FRAMES = 3
# Images that were preprocessed differently cannot be compared.
_PREPROCESSING = [p.name for p in Parameters.describe() if p.stage == "preprocessing"]


class ImageError(ValueError):
    """An image that the pipeline cannot process; the message says why."""


@dataclass
class FrameResult:
    """What one frame gave.

    Attributes
    ----------
    stamp_ns : int
        Its stamp, ns UTC.
    frame : int
        Count of frames that the pipeline processed before it.
    shape : (height, width)
        Size of the image, px.
    dt_s : float
        Time since the frame it was compared with, s; NaN if there was none.
    reset : str
        Why there was none, in words; empty if there was.
    objects : (N,) OBJECT_DTYPE
        Objects of this frame.
    flow : Flow
        Flow from the previous frame to this one.
    star_field : StarFieldMotion or None
        Motion of the star field; None if it was not found.
    detections : (K,) DETECTION_DTYPE
        RSOs in this frame, confirmed ones and candidates.
    tracks : (N,) TRACK_DTYPE
        Confirmed tracks, coasting ones included; test history only.
    settled : list of Settled
        The last word on frames, in their order, with what later frames taught: the look back.
        Without test history, of this frame.
    spot_count : int
        Spots that are not the star field's: RSOs, noise, cosmic rays, defects.
    background, noise, threshold : float
        Median level of the background, std of the smoothed background, threshold over the
        background, DN.
    reason : str
        Why nothing was detected, in words; empty if something was.
    seconds : dict
        Time that each stage took, s.
    """

    stamp_ns: int
    frame: int
    shape: tuple[int, int]
    dt_s: float = float("nan")
    reset: str = ""
    objects: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, OBJECT_DTYPE))
    flow: Flow = field(default_factory=Flow.empty)
    star_field: StarFieldMotion | None = None
    detections: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, DETECTION_DTYPE))
    tracks: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, TRACK_DTYPE))
    settled: list[Settled] = field(default_factory=list)
    spot_count: int = 0
    background: float = float("nan")
    noise: float = float("nan")
    threshold: float = float("nan")
    reason: str = ""
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def star_rows(self) -> NDArray[np.intp]:
        """Rows of the flow that are stars': they move with the field and are no detection's."""
        if self.star_field is None:
            return np.zeros(0, np.intp)
        own = self.detections["object_index"]
        of_rso = np.isin(self.flow.object_index, own[own >= 0])
        of_rso[self.detections["flow_index"][self.detections["flow_index"] >= 0]] = True
        return np.flatnonzero(self.star_field.inliers & ~of_rso)


@dataclass(frozen=True)
class _Previous:
    """What is kept of the previous frame."""

    stamp_ns: int
    dtype: np.dtype
    parameters: Parameters
    objects: NDArray[np.void]
    flow_input: FlowInput


class Pipeline:
    """Detect RSOs in a sequence of images.

    Parameters
    ----------
    parameters : Parameters, optional
        The choices of all stages; default: the preset ``robust``.  The attribute may be assigned
        at any time and takes effect at the next frame.

    Examples
    --------
    >>> pipeline = Pipeline(Parameters.preset("robust"))
    >>> image = np.zeros((64, 64), np.uint16)
    >>> pipeline.process(image, stamp_ns=0).reset
    'first frame'
    """

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.parameters = parameters or Parameters.preset()
        self._previous: _Previous | None = None
        self._sensor = SensorMemory()
        self._history = History(self.parameters.history_frames)
        look = partial(spot_near, radius_px=_CLOSER_PX, least_sigmas=_CLOSER_SIGMAS)
        self._tracker = Tracker(look, refine)
        self._settled: list[Settled] = []
        # The smoothed image of a frame that has left the history: fresh memory costs time.
        self._spare: NDArray[np.float32] | None = None
        # The field's last motion, per second.
        self._field_rate: StarFieldMotion | None = None
        self._blind = 0
        self._reset_reason = "first frame"
        self._frames = 0

    def reset(self, reason: str = "reset asked for") -> None:
        """Forget all frames and end all tracks; the next frame starts afresh and says `reason`."""
        self._previous = None
        self._forget()
        self._reset_reason = reason

    def finish(self) -> list[Settled]:
        """Say the last word on the frames that it was not said of yet, and start afresh."""
        self.reset("finished")
        self._sensor = SensorMemory()
        settled, self._settled = self._settled, []
        return settled

    def _forget(self) -> None:
        """End all tracks and drop the history; the last word on it goes with the next frame."""
        self._settled += self._tracker.clear(self._history)
        self._history.clear()
        self._field_rate = None

    def process(self, image: NDArray[np.generic], stamp_ns: int) -> FrameResult:
        """Process the next image.

        Parameters
        ----------
        image : (H, W) uint8, uint16 or float32
            The image, DN; at least 16 px on each side.  It is not changed.
        stamp_ns : int
            Middle of the exposure, ns UTC.

        Returns
        -------
        FrameResult

        Raises
        ------
        ImageError
            If the image has another type or shape, or no finite pixel.  The previous frame stays
            as it was.
        """
        _check(image)
        parameters = self.parameters
        result = FrameResult(stamp_ns, self._frames, (image.shape[0], image.shape[1]))
        # Given away: what is in it from now on is this frame's.
        spare, self._spare = self._spare, None
        with _timed(result.seconds, "preprocessing"):
            try:
                pre = preprocess(image, parameters, self._sensor, spare)
            except ValueError as error:
                raise ImageError(str(error)) from error
        self._frames += 1
        result.background, result.noise, result.threshold = (
            pre.background,
            pre.noise,
            pre.threshold,
        )
        with _timed(result.seconds, "objects"):
            result.objects, regions = find_objects(
                pre.above,
                pre.image_at(pre.above),
                pre.smoothed,
                pre.pixel_noise,
                pre.noise,
                pre.noise_ratio,
                parameters.min_area_px,
                parameters.max_objects,
            )
        xy, sigma = _pairs(result.objects, "x", "y"), _pairs(result.objects, "sigma_x", "sigma_y")
        length = result.objects["length"]
        current = FlowInput(
            pre.smoothed, pre.above, pre.pedestal, regions, xy, sigma, length, pre.noise
        )

        previous = self._usable_previous(image, stamp_ns, parameters)
        result.reset, self._reset_reason = self._reset_reason, ""
        if previous is not None:
            result.dt_s = (stamp_ns - previous.stamp_ns) / 1e9
            self._compare(previous, current, result, parameters)
        if parameters.rso_test == "history":
            self._remember(pre, regions, result, parameters)
            self._track(pre.defects, result, parameters)
        else:
            self._forget()
            self._settled.append(Settled(result.frame, stamp_ns, result.detections))
        result.settled, self._settled = self._settled, []
        self._previous = _Previous(stamp_ns, image.dtype, parameters, result.objects, current)
        result.reason = _why_nothing(result)
        return result

    def _usable_previous(
        self, image: NDArray[np.generic], stamp_ns: int, parameters: Parameters
    ) -> _Previous | None:
        """The previous frame, or None with the reason in `_reset_reason`."""
        previous = self._previous
        if previous is None:
            return None
        before, now = previous.flow_input.smoothed.shape, image.shape
        dt_s = (stamp_ns - previous.stamp_ns) / 1e9
        max_gap_s = parameters.max_gap_s
        changed = [
            name
            for name in _PREPROCESSING
            if getattr(parameters, name) != getattr(previous.parameters, name)
        ]
        if before != now:
            self.reset(
                f"the image's size changed from {before[1]}x{before[0]} to {now[1]}x{now[0]}"
            )
        elif previous.dtype != image.dtype:
            self.reset(f"the image's type changed from {previous.dtype} to {image.dtype}")
        elif dt_s == 0:
            self.reset("two frames have the same stamp")
        elif dt_s < 0:
            self.reset(f"time ran backwards by {-dt_s:g} s")
        elif dt_s > max_gap_s:
            self.reset(f"a gap of {dt_s:g} s is longer than max_gap_s = {max_gap_s:g} s")
        elif changed:
            self.reset(f"{' and '.join(changed)} changed")
        return self._previous

    def _compare(
        self, previous: _Previous, current: FlowInput, result: FrameResult, parameters: Parameters
    ) -> None:
        """Fill in flow, star field and detections."""
        expected = self._field_rate and self._field_rate.over(result.dt_s)
        guesses = np.zeros((1, 2))
        if parameters.first_guess == "field":
            with _timed(result.seconds, "star_field"):
                shift = vote_shift(
                    previous.flow_input.xy,
                    previous.objects["flux"],
                    current.xy,
                    result.objects["flux"],
                )
            if shift is None and expected is not None:
                # Too few votes to tell from chance: a mount most likely goes on as it did.
                shift = expected.displacement
            if shift is not None:
                # No motion comes second: in rate tracking the RSOs stand still.
                guesses = np.stack([shift, np.zeros(2)])
        with _timed(result.seconds, "optical_flow"):
            flow = flow_engine(parameters).measure(previous.flow_input, current, guesses)
        result.flow = flow
        with _timed(result.seconds, "star_field"):
            valid = flow.valid
            motion = estimate_motion(
                flow.position[valid],
                flow.displacement[valid],
                flow.sigma[valid],
                flow.speed_mean[valid],
                result.shape,
                parameters.star_field_model,
                parameters.outlier_sigmas,
            )
        before, now = len(previous.objects), len(result.objects)
        if motion is None or not motion.is_credible(expected, before, now):
            return
        inliers = np.zeros(len(flow), bool)
        inliers[valid] = motion.inliers
        result.star_field = motion.with_inliers(inliers)
        if parameters.rso_test == "history":
            return
        with _timed(result.seconds, "detection"):
            result.detections = detect(
                result.objects,
                flow,
                motion,
                previous.flow_input,
                current,
                result.dt_s,
                parameters.rso_test,
                parameters.rso_sigmas,
                parameters.min_relative_px,
            )

    def _remember(
        self,
        pre: Preprocessed,
        regions: Regions,
        result: FrameResult,
        parameters: Parameters,
    ) -> None:
        """Add the frame to the history, at its place on the sky."""
        if parameters.history_frames != self._history.length:
            old, self._history = self._history, History(parameters.history_frames)
            # This frame needs a place, too.
            leaving = max(0, len(old) + 1 - parameters.history_frames)
            self._settled += self._tracker.settle(old, leaving)
            for frame in old:
                self._history.add(frame)
        motion = result.star_field
        self._blind = 0 if motion is not None else self._blind + 1
        if self._blind > _BLIND_FRAMES:
            # Where the stars went meanwhile is not known: what follows is another sky.
            self._forget()
        if motion is not None:
            self._field_rate = motion.over(1 / result.dt_s)
        elif self._field_rate is not None:
            motion = self._field_rate.over(result.dt_s)
        to_sky = self._history.place(motion)
        full = len(self._history) == self._history.length
        self._spare = self._history[0].smoothed if full else None
        self._history.add(
            PastFrame(
                number=result.frame,
                stamp_ns=result.stamp_ns,
                smoothed=pre.smoothed,
                noise=pre.noise,
                noise_ratio=pre.noise_ratio,
                objects=result.objects,
                regions=regions,
                bright=pre.bright,
                to_sky=to_sky,
            )
        )

    def _track(self, defects: int, result: FrameResult, parameters: Parameters) -> None:
        """Fill in detections and tracks from the history."""
        history = self._history
        if len(history) < 2:
            return
        # The first frame has no other to compare it with until the second is there.
        fresh = list(history)[-2:] if len(history) == 2 else [history[-1]]
        log_limit = float(np.log(parameters.false_tracks))
        with _timed(result.seconds, "detection"):
            spots = [
                find_spots(frame, history.others(frame), parameters.spot_sigmas) for frame in fresh
            ]
        result.spot_count = len(spots[-1])
        with _timed(result.seconds, "tracking"):
            tracked = self._tracker.update(
                history,
                spots,
                partial(find_drifting, history, log_limit),
                defects,
                log_limit,
                parameters.max_speed_px,
                parameters.coast_frames,
            )
        result.detections, result.tracks = tracked.detections, tracked.tracks
        self._settled += tracked.settled


def _check(image: NDArray[np.generic]) -> None:
    if image.ndim != 2 or min(image.shape) < _SMALLEST_SIDE:
        raise ImageError(
            f"an image of shape {image.shape} cannot be processed: it must have two dimensions"
            f" of at least {_SMALLEST_SIDE} px"
        )
    if image.dtype.name not in _DTYPES:
        raise ImageError(
            f"an image of {image.dtype.name} cannot be processed: it must be {', '.join(_DTYPES)}"
        )


def _pairs(objects: NDArray[np.void], first: str, second: str) -> NDArray[np.float64]:
    return np.stack([objects[first], objects[second]], axis=1)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start


def _why_nothing(result: FrameResult) -> str:
    """In words, why the frame has no detection."""
    if len(result.detections):
        return ""
    if not len(result.objects):
        return "no object is above the threshold"
    if result.reset:
        return f"no previous frame to compare with: {result.reset}"
    valid = int(np.count_nonzero(result.flow.valid))
    if not valid:
        return f"none of {len(result.objects)} objects was found in the previous frame"
    if result.star_field is None:
        return f"the {valid} flow vectors do not agree on a motion of the star field"
    if valid == 1:
        return "only one object was found in the previous frame: no star field to compare it with"
    stars = result.star_field.star_count
    if not result.spot_count:
        return f"everything moves with the star field ({stars} stars)"
    coasting = f"; tracks that coast: {len(result.tracks)}" if len(result.tracks) else ""
    return (
        f"{stars} stars; none of {result.spot_count} spots beside them lies on a path that noise"
        f" would not explain{coasting}"
    )
