# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The pipeline: the order of the stages, and what is kept of the frames before.

The one place that knows all stages.  Live nodes and offline commands feed it one image at a time
and get a `FrameResult`; what is different between them lies outside.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.comoving import find_comoving
from ofsat_ros.comparison import (
    Seen,
    find_motion,
    is_near,
    measure_flow,
    why_another_field,
    why_not_comparable,
    why_not_placed,
)
from ofsat_ros.detection import (
    Drift,
    detect,
    find_drifting,
    find_spots,
    refine,
    spot_near,
)
from ofsat_ros.frame_result import FrameResult, why_nothing
from ofsat_ros.history import History, PastFrame
from ofsat_ros.objects import find_objects
from ofsat_ros.optical_flow import FlowInput
from ofsat_ros.parameters import Parameters
from ofsat_ros.pixels import Regions, positions, rows_and_columns
from ofsat_ros.preprocessing import Preprocessed, SensorMemory, learn, preprocess
from ofsat_ros.star_field import StarFieldMotion
from ofsat_ros.timeline import AstrayError, Timeline
from ofsat_ros.tracking import TRACK_DTYPE, Settled, Tracker

# What is done with an image and its stamp.
_Act = Callable[[NDArray[np.generic], int], FrameResult]

_SMALLEST_SIDE = 16
_DTYPES = ("uint8", "uint16", "float32")
# Where a track is expected, a closer look finds what is a spot of this many sigmas, this near, px.
_CLOSER_SIGMAS, _CLOSER_PX = 2.0, 2
# Frames in a row over which the field's motion is taken to go on when too few stars show it.
_BLIND_FRAMES = 3


class ImageError(ValueError):
    """An image that the pipeline cannot process; the message says why."""


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
        self._previous: Seen | None = None
        self._timeline = Timeline()
        self._has_learned = False
        # An image whose stamp is not believed yet, with that stamp.
        self._held: tuple[NDArray[np.generic], int] | None = None
        self._sensor = SensorMemory()
        self._history = History(self.parameters.history_frames)
        look = partial(spot_near, radius_px=_CLOSER_PX, least_sigmas=_CLOSER_SIGMAS)
        self._tracker = Tracker(look, refine)
        self._settled: list[Settled] = []
        # The smoothed image of a frame that has left the history: fresh memory costs time.
        self._spare: NDArray[np.float32] | None = None
        # The field's last motion, per second, and the last that may have been chance.
        self._field_rate: StarFieldMotion | None = None
        self._doubted_rate: StarFieldMotion | None = None
        # Where on the sky the previous frame is, and the tracks of the last one, with its stamp.
        self._since: NDArray[np.float64] | None = None
        self._tracks = np.zeros(0, TRACK_DTYPE), 0
        # Frames in a row that show no star field.
        self._blind, self._guessing = 0, False
        self._reset_reason = "first frame"
        self._frames = 0

    def reset(self, reason: str = "reset asked for") -> None:
        """Forget all frames and end all tracks; the next frame starts afresh and says `reason`."""
        self._previous, self._blind = None, 0
        self._reset_reason = reason
        self._forget()

    def finish(self) -> list[Settled]:
        """Say the last word on the frames that it was not said of yet, and start afresh."""
        self.reset("finished")
        self._sensor = SensorMemory()
        settled, self._settled = self._settled, []
        return settled

    def _forget(self) -> None:
        """End all tracks and drop the history; the last word on it goes with the next frame."""
        try:
            self._settled += self._tracker.clear(self._history)
        finally:
            self._history.clear()
            self._field_rate = self._since = None
            self._tracks = np.zeros(0, TRACK_DTYPE), 0

    def learn(self, image: NDArray[np.generic], stamp_ns: int) -> None:
        """Take of the next image only what it teaches of the sensor, and of the camera's times.

        For a start in the middle of a recording: what is processed then goes on from there as if
        all had been processed, but for tracks, which are born anew.  Parameters and errors are
        those of `process`.
        """
        self._take(image, stamp_ns, self._learn)

    def process(self, image: NDArray[np.generic], stamp_ns: int) -> FrameResult:
        """Process the next image.

        Parameters
        ----------
        image : (H, W) uint8, uint16 or float32
            The image, DN; at least 16 px on each side.  It is not changed, and must not be before
            the next one.
        stamp_ns : int
            Middle of the exposure, ns UTC.

        Returns
        -------
        FrameResult

        Raises
        ------
        ImageError
            If the image has another type or shape, or no finite pixel, or its stamp is astray
            (`Timeline`).  The previous frame stays as it was.  If the next stamp goes on from
            one that was astray, its result brings what this frame gave.
        """
        return self._take(image, stamp_ns, self._process)

    def _take(self, image: NDArray[np.generic], stamp_ns: int, act: _Act) -> FrameResult:
        """Do something with an image that is one, and leave a clean state whatever happens."""
        _check(image)
        try:
            return self._follow(image, stamp_ns, act)
        except ImageError:
            raise
        except BaseException:
            # A fault, or Ctrl-C: what is half done must not go on into the next frames.
            self.reset("an error in the frame before")
            raise

    def _follow(self, image: NDArray[np.generic], stamp_ns: int, act: _Act) -> FrameResult:
        """Refuse a stamp that is astray; start afresh where time has jumped."""
        held, self._held = self._held, None
        if self._previous is None and not self._has_learned:
            self._timeline = Timeline()
        try:
            jump_s = self._timeline.judge(stamp_ns)
        except AstrayError as error:
            if self._timeline.awaits(stamp_ns):
                self._held = image, stamp_ns
            raise ImageError(str(error)) from error
        before = None
        if jump_s:
            how = "jumped ahead" if jump_s > 0 else "ran backwards"
            self.reset(f"time {how} by {abs(jump_s):g} s")
            if held is not None:
                with suppress(ImageError):
                    before = act(*held)
        result = act(image, stamp_ns)
        self._timeline.take(stamp_ns)
        if before is not None:
            result.held_back = before
            result.settled, before.settled = before.settled + result.settled, []
        return result

    def _learn(self, image: NDArray[np.generic], stamp_ns: int) -> FrameResult:
        try:
            learn(image, self.parameters, self._sensor)
        except ValueError as error:
            raise ImageError(str(error)) from error
        self._frames += 1
        self._has_learned = True
        return FrameResult(stamp_ns, self._frames - 1, (image.shape[0], image.shape[1]))

    def _process(self, image: NDArray[np.generic], stamp_ns: int) -> FrameResult:
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
        self._has_learned = False
        result.background, result.noise = pre.background, pre.noise
        result.threshold = pre.threshold
        with _timed(result.seconds, "objects"):
            current = _seen(pre, stamp_ns, image.dtype, parameters)
        result.objects = current.objects
        if self._previous is not None and (why := why_not_comparable(self._previous, current)):
            self.reset(why)
        if self._previous is not None:
            self._compare(self._previous, current, result, parameters)
        result.reset, self._reset_reason = self._reset_reason, ""
        # What shows no stars is no frame to compare with, unless it goes on for long.
        blind = self._previous is not None and (pre.veiled or result.star_field is None)
        self._blind = self._blind + 1 if blind else 0
        # Where no star was ever seen there is none that could be taken for an RSO.
        known = self._places_expected(stamp_ns)
        self._guessing = blind and (self._field_rate is not None or current.shows_stars(known))
        if parameters.rso_test == "history":
            self._remember(pre, current.flow_input.regions, result, parameters)
            current, drifts = self._straighten(current, result)
            self._track(pre.defects, drifts, result, parameters)
        else:
            self._forget()
            self._settled.append(Settled(result.frame, stamp_ns, result.detections))
        result.settled, self._settled = self._settled, []
        # Where no motion is known yet, the frame that shows more is the better one.
        worse = self._field_rate is not None or not current.shows_as_much_as(self._previous)
        if not (0 < self._blind <= _BLIND_FRAMES and worse):
            self._previous = current
            self._since = self._history[-1].to_sky if len(self._history) else None
        result.reason = why_nothing(result, image, pre.veiled)
        return result

    def _compare(
        self, previous: Seen, current: Seen, result: FrameResult, parameters: Parameters
    ) -> None:
        """Fill in flow, star field and detections; start afresh if it is another field."""
        dt_s = (current.stamp_ns - previous.stamp_ns) / 1e9
        expected = self._field_rate and self._field_rate.over(dt_s)
        doubted = self._doubted_rate and self._doubted_rate.over(dt_s)
        with _timed(result.seconds, "optical_flow"):
            flow = measure_flow(previous, current, expected or doubted, parameters)
        with _timed(result.seconds, "star_field"):
            motion, believed = find_motion(flow, previous, current, expected, doubted, parameters)
        if believed:
            self._doubted_rate = None
        else:
            if motion is not None:
                self._doubted_rate, motion = motion.over(1 / dt_s), None
            known = self._places_expected(current.stamp_ns)
            if why := why_another_field(previous, current, known, expected is not None):
                self.reset(why)
                return
        with_history = parameters.rso_test == "history"
        if with_history and motion is not None and (why := why_not_placed(motion, expected)):
            self.reset(why)
            return
        result.dt_s, result.flow, result.star_field = dt_s, flow, motion
        if motion is None or with_history:
            return
        with _timed(result.seconds, "detection"):
            result.detections = detect(
                result.objects,
                flow,
                motion,
                previous.flow_input,
                current.flow_input,
                dt_s,
                parameters.rso_test,
                parameters.rso_sigmas,
                parameters.min_relative_px,
            )

    def _places_expected(self, stamp_ns: int) -> NDArray[np.float64]:
        """Where the tracks are if all goes on as it did, (K, 2) px."""
        tracks, since_ns = self._tracks
        seconds = (stamp_ns - since_ns) / 1e9
        return positions(tracks) + seconds * np.stack([tracks["vx"], tracks["vy"]], axis=1)

    def _remember(
        self, pre: Preprocessed, regions: Regions, result: FrameResult, parameters: Parameters
    ) -> None:
        """Add the frame to the history, at its place on the sky."""
        if parameters.history_frames != self._history.length:
            old, self._history = self._history, History(parameters.history_frames)
            # This frame needs a place, too.
            leaving = max(0, len(old) + 1 - parameters.history_frames)
            self._tracker.settle(old, leaving)
            for frame in old:
                self._history.add(frame)
        motion, bright = result.star_field, pre.bright
        if self._guessing:
            # Where it is on the sky is a guess: it goes on with tracks, and shows nothing new.
            y, x = rows_and_columns(bright, result.shape[1])
            known = self._places_expected(result.stamp_ns)
            bright = bright[is_near(np.stack([x, y], axis=1).astype(float), known)]
        if self._guessing and self._blind > _BLIND_FRAMES:
            # Where the stars went meanwhile is not known: what follows is another sky.
            self._forget()
        if motion is not None:
            self._field_rate = motion.over(1 / result.dt_s)
        elif rate := self._field_rate or self._doubted_rate:
            motion = rate.over(result.dt_s)
        to_sky = self._history.place(motion, self._since)
        leaves = self._history[0].smoothed if len(self._history) == self._history.length else None
        # While no stars are seen, frames are compared with one that may have left.
        self._spare = None if self._blind else leaves
        self._history.add(
            PastFrame(
                number=result.frame,
                stamp_ns=result.stamp_ns,
                smoothed=pre.smoothed,
                noise=pre.noise,
                noise_ratio=pre.noise_ratio,
                objects=result.objects,
                regions=regions,
                bright=bright,
                blind=pre.blind,
                to_sky=to_sky,
                scatter=1.0 if motion is None else motion.residual_sigmas,
            )
        )

    def _straighten(self, current: Seen, result: FrameResult) -> tuple[Seen, list[Drift]]:
        """Tell what is no star where there are few, and put right what was taken for one."""
        before = self._previous
        # A frame that others are not compared with puts nothing right.
        if before is None or result.star_field is None or self._blind:
            return current, []
        doubtful = result.star_field.is_doubtful
        tracks = self._tracker.paths(self._history) if doubtful else None
        comoving = find_comoving(self._history, tracks)
        if comoving is None:
            # What was no star does not become one because stars are hidden.
            strays = np.unique(result.flow.object_index[before.leads_astray(result.flow)])
            return replace(current, strays=strays[strays >= 0]), []
        stamps = [frame.stamp_ns for frame in self._history]
        if before.stamp_ns not in stamps:
            return current, []
        if comoving.to_sky is not None:
            history, motion, flow = self._history, result.star_field, result.flow
            history.straighten(comoving.to_sky)
            stars = positions(result.objects)[comoving.stars]
            self._tracker.straighten(history, stars, comoving.tracks)
            there = history[stamps.index(before.stamp_ns)]
            motion = motion.led_by(there.from_sky @ history[-1].to_sky)
            inliers = flow.valid & np.isin(flow.object_index, comoving.stars)
            if not inliers.any():
                inliers = motion.inliers & ~np.isin(flow.object_index, comoving.strays)
            result.star_field = motion.with_inliers(inliers)
            self._field_rate = result.star_field.over(1 / result.dt_s)
        return replace(current, strays=comoving.strays), comoving.drifts

    def _track(
        self, defects: int, drifts: list[Drift], result: FrameResult, parameters: Parameters
    ) -> None:
        """Fill in detections and tracks from the history, and from what is known to drift."""
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
                lambda known: drifts or self._find_drifting(known, log_limit),
                defects,
                log_limit,
                parameters.max_speed_px,
                parameters.coast_frames,
            )
        result.detections, result.tracks = tracked.detections, tracked.tracks
        self._tracks = tracked.tracks, result.stamp_ns
        self._settled += tracked.settled

    def _find_drifting(self, known: NDArray[np.intp], log_limit: float) -> list[Drift]:
        """Find what drifts; nothing among stars whose place is a guess, of which all drift."""
        return [] if self._guessing else find_drifting(self._history, log_limit, known)


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


def _seen(pre: Preprocessed, stamp_ns: int, dtype: np.dtype, parameters: Parameters) -> Seen:
    """Find the objects of a frame, and set them out for comparison with others."""
    objects, regions = find_objects(
        pre.above,
        pre.image_at(pre.above),
        pre.smoothed,
        pre.pixel_noise,
        pre.noise,
        pre.noise_ratio,
        parameters.min_area_px,
        parameters.max_objects,
        pre.blind,
    )
    flow_input = FlowInput(
        smoothed=pre.smoothed,
        above=pre.above,
        pedestal=pre.pedestal,
        regions=regions,
        xy=positions(objects),
        sigma=np.stack([objects["sigma_x"], objects["sigma_y"]], axis=1),
        length=objects["length"],
        noise=pre.noise,
    )
    return Seen(stamp_ns, dtype, parameters, objects, flow_input)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
