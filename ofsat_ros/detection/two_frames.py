# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Detection: which objects do not move with the star field.

Fifth stage: takes objects, their flow and the field's motion, and returns the RSO candidates of
one frame.  What a later frame confirms or denies is not known here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.optical_flow import Flow, FlowInput
from ofsat_ros.star_field import StarFieldMotion

CANDIDATE, CONFIRMED = 0, 1
# Gaussian width of a point source in the smoothed image, px: a PSF of about 1 and the smoothing.
POINT_WIDTH_PX = 1.4
# What is measured of an object, a spot or a detection alike.
MEASURED_FIELDS = ("x", "y", "sigma_x", "sigma_y", "snr", "flux", "length", "angle")
# What only a calibrated camera and an attitude give (`camera`); unknown until then.
DIRECTION_FIELDS = ("sight", "ra", "dec", "sigma_ra", "sigma_dec")

DETECTION_DTYPE = np.dtype(
    [
        ("x", "f8"),  # centroid, px
        ("y", "f8"),
        ("vx", "f8"),  # velocity in the image, px/s
        ("vy", "f8"),
        ("rel_vx", "f8"),  # velocity against the star field, px/s
        ("rel_vy", "f8"),
        ("sigma_x", "f8"),  # std of the centroid, px
        ("sigma_y", "f8"),
        ("snr", "f8"),
        ("flux", "f8"),  # DN
        ("length", "f8"),  # px
        ("angle", "f8"),  # rad, from x to y
        ("sight", "f8", (3,)),  # unit line of sight, optical frame; NaN without calibration
        ("ra", "f8"),  # rad, ICRS; NaN without attitude
        ("dec", "f8"),
        ("sigma_ra", "f8"),  # std along the equator (of ra times cos dec), rad
        ("sigma_dec", "f8"),
        ("significance", "f8"),  # of the motion against the field, in sigmas
        ("track_id", "u4"),  # 0: not confirmed
        ("status", "u1"),  # CANDIDATE or CONFIRMED
        ("object_index", "i4"),  # row of the objects, -1 for none
        ("flow_index", "i4"),  # row of the flow
    ]
)


def detect(
    objects: NDArray[np.void],
    flow: Flow,
    field: StarFieldMotion,
    previous: FlowInput,
    current: FlowInput,
    dt_s: float,
    test: str = "vector",
    sigmas: float = 6.0,
    min_relative_px: float = 0.3,
) -> NDArray[np.void]:
    """Find what moves otherwise.

    Parameters
    ----------
    objects : (N,) OBJECT_DTYPE
        Objects of the current frame.
    flow : Flow
        Its flow vectors.
    field : StarFieldMotion
        The motion of the star field over the same time.
    previous, current : FlowInput
        The two frames; test vector only.
    dt_s : float
        Time between the two frames, s; greater than 0.
    test : {"vector", "speed"}
        vector: the difference from the field's motion exceeds `sigmas` of its uncertainty and
        `min_relative_px`, and the previous frame was darker where the field's motion says that a
        star would have been.  speed: the speed lies outside the field's mean +- `sigmas` std, as
        published (AAS 21-364).
    sigmas : float
        See `test`.
    min_relative_px : float
        Least displacement against the field, px per frame; test vector only.

    Returns
    -------
    (K,) DETECTION_DTYPE
        One detection per object, or per vector that belongs to no object.  SNR, flux and shape
        of a vector without object are NaN.
    """
    relative = flow.displacement - field.displacement_at(flow.position)
    if test == "speed":
        deviation = np.abs(flow.speed_mean - field.speed_mean)
        significance = deviation / max(field.speed_std, 1e-9)
        flagged = flow.valid & (significance > sigmas)
    else:
        stated = (field.residual_sigmas * flow.sigma) ** 2
        variance = stated + field.variance_at(flow.position)
        significance = np.sqrt(np.sum(relative**2 / variance, axis=1))
        far = np.hypot(*relative.T) >= min_relative_px
        flagged = flow.valid & (significance > sigmas) & far & ~_at_edge(objects, flow)
        flagged &= ~_was_there(flow, field, relative, previous, current)
    rows = np.flatnonzero(flagged)
    # Of several vectors of one object, the most significant.
    rows = rows[np.argsort(-significance[rows], kind="stable")]
    rows = np.sort(rows[first_of_each(flow.object_index[rows])])
    return _detections(rows, objects, flow, relative, significance, dt_s)


def _was_there(
    flow: Flow,
    field: StarFieldMotion,
    relative: NDArray[np.float64],
    previous: FlowInput,
    current: FlowInput,
) -> NDArray[np.bool_]:
    """Whether the previous frame shows each object where the star field's motion puts it.

    Brightness constancy under the field's motion: a star was there, also as a piece of a broken
    streak whose own vector is wrong.  An RSO was not, but a slow one had not gone far: a point
    source seen `relative` away from its centre has fallen to exp(-relative^2 / (4 width^2)), and
    the brightness must be nearer to that than to constancy.
    """
    now = current.brightness_at(flow.position)
    before = previous.brightness_at(flow.position - field.displacement_at(flow.position))
    fallen = np.exp(-np.sum(relative**2, axis=1) / (4 * POINT_WIDTH_PX**2))
    slack = previous.noise + current.noise
    return before > now * (1 + fallen) / 2 - slack


def _at_edge(objects: NDArray[np.void], flow: Flow) -> NDArray[np.bool_]:
    """Vectors of objects that the image's border cuts: their centroids move as they are cut."""
    index = flow.object_index
    at_edge = np.zeros(len(flow), bool)
    at_edge[index >= 0] = objects["edge"][index[index >= 0]]
    return at_edge


def first_of_each(object_index: NDArray[np.integer]) -> NDArray[np.intp]:
    """Rows of the first of several of one object, and of each of none (-1), in their order."""
    owner = np.where(object_index >= 0, object_index, -1 - np.arange(len(object_index)))
    return np.sort(np.unique(owner, return_index=True)[1])


def _detections(
    rows: NDArray[np.intp],
    objects: NDArray[np.void],
    flow: Flow,
    relative: NDArray[np.float64],
    significance: NDArray[np.float64],
    dt_s: float,
) -> NDArray[np.void]:
    found = np.zeros(len(rows), DETECTION_DTYPE)
    index = flow.object_index[rows]
    found["flow_index"], found["object_index"] = rows, index
    found["x"], found["y"] = flow.position[rows].T
    found["sigma_x"], found["sigma_y"] = flow.sigma[rows].T
    for name in ("snr", "flux", "length", "angle", *DIRECTION_FIELDS):
        found[name] = np.nan
    owned = index >= 0
    for name in MEASURED_FIELDS:
        found[name][owned] = objects[name][index[owned]]
    found["vx"], found["vy"] = flow.displacement[rows].T / dt_s
    found["rel_vx"], found["rel_vy"] = relative[rows].T / dt_s
    found["significance"] = significance[rows]
    return found
