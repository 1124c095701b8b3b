# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What one frame gave: the pipeline's answer, and why there is nothing in it.

Stands at the end of the flow: every front, live or offline, shows and writes what is here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.objects import OBJECT_DTYPE
from ofsat_ros.optical_flow import Flow
from ofsat_ros.preprocessing import blank_words
from ofsat_ros.star_field import StarFieldMotion
from ofsat_ros.tracking import TRACK_DTYPE, Settled


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
    held_back : FrameResult or None
        What the frame before gave, if it was refused for its stamp, which this one confirms.
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
    held_back: FrameResult | None = None
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


def why_nothing(result: FrameResult, image: NDArray[np.generic], veiled: bool) -> str:
    """Say in words why a frame has no detection; empty if it has one.

    Parameters
    ----------
    result : FrameResult
        All but its reason.
    image : (H, W) array
    veiled : bool
        Whether most of the image is structure.
    """
    if len(result.detections):
        return ""
    if veiled:
        return "most of the image is structure, not noise: clouds or bands hide what is faint"
    if not len(result.objects):
        return blank_words(image) or "no object is above the threshold"
    if result.reset:
        return f"no previous frame to compare with: {result.reset}"
    valid = int(np.count_nonzero(result.flow.valid))
    if not valid:
        return f"none of {len(result.objects)} objects was found in the previous frame"
    if valid == 1:
        return "only one object was found in the previous frame: no star field to compare it with"
    if result.star_field is None:
        return f"the {valid} flow vectors do not agree on a motion of the star field"
    stars = result.star_field.star_count
    if not result.spot_count:
        return f"everything moves with the star field ({stars} stars)"
    coasting = f"; tracks that coast: {len(result.tracks)}" if len(result.tracks) else ""
    return (
        f"{stars} stars; none of {result.spot_count} spots beside them lies on a path that noise"
        f" would not explain{coasting}"
    )
