# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The messages of results, whichever library's classes they are made of.

What ``rso_detections``, ``rso_tracks``, ``flow_markers`` and ``star_field_motion`` hold is said
here, once: the nodes make them of ROS's classes, and a bag of results of rosbags', which need no
ROS.  Every message bears the header it is given, so that a result has its image's stamp and frame.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED, DETECTION_DTYPE
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

Rows = NDArray[np.void]
Message = Any  # of either library

# What a maker of messages needs the classes of.
MESSAGE_TYPES = {
    "ColorRGBA": "std_msgs/msg/ColorRGBA",
    "Marker": "visualization_msgs/msg/Marker",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Point": "geometry_msgs/msg/Point",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "PointField": "sensor_msgs/msg/PointField",
    "Vector3Stamped": "geometry_msgs/msg/Vector3Stamped",
}

# One row of rso_detections and rso_truth.  Aligned as a C struct, for readers in C++.
CLOUD_DTYPE = np.dtype(
    [(name, "f4") for name in ("x", "y", "z")]
    + [(name, "f8") for name in ("u", "v", "u_rate", "v_rate", "rel_u_rate", "rel_v_rate")]
    + [(name, "f8") for name in ("sigma_u", "sigma_v", "snr", "flux", "length", "angle")]
    + [("id", "u4"), ("ra", "f8"), ("dec", "f8"), ("status", "u1")]
    + [("sigma_ra", "f8"), ("sigma_dec", "f8")],
    align=True,
)
# One row of rso_tracks: the same, and what only a track has.
TRACK_CLOUD_DTYPE = np.dtype(
    [(name, CLOUD_DTYPE[name]) for name in CLOUD_DTYPE.names or ()]
    + [(name, "f8") for name in ("sigma_u_rate", "sigma_v_rate", "age")]
    + [(name, "u4") for name in ("hits", "misses")],
    align=True,
)
# sensor_msgs/PointField's codes.
_POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_DTYPES = {code: name for name, code in _POINT_TYPES.items()}
_DETECTION_FIELDS = {
    "u": "x",
    "v": "y",
    "u_rate": "vx",
    "v_rate": "vy",
    "rel_u_rate": "rel_vx",
    "rel_v_rate": "rel_vy",
    "sigma_u": "sigma_x",
    "sigma_v": "sigma_y",
    "snr": "snr",
    "flux": "flux",
    "length": "length",
    "angle": "angle",
    "id": "track_id",
    "ra": "ra",
    "dec": "dec",
    "sigma_ra": "sigma_ra",
    "sigma_dec": "sigma_dec",
    "status": "status",
}
_TRACK_FIELDS = _DETECTION_FIELDS | {
    "sigma_u_rate": "sigma_vx",
    "sigma_v_rate": "sigma_vy",
    "age": "age",
    "hits": "hits",
    "misses": "misses",
}

_BLUE = {"r": 0.2, "g": 0.5, "b": 1.0, "a": 1.0}
_RED = {"r": 1.0, "g": 0.15, "b": 0.1, "a": 1.0}
_YELLOW = {"r": 1.0, "g": 0.85, "b": 0.2, "a": 1.0}
# px; half the side of the box around an RSO, beyond half its streak.
_BOX_MARGIN_PX = 8.0
# Part of a side that the corner of an open box is long.
_CORNER = 0.3
_LINE_WIDTH_PX = 1.0
_TEXT_HEIGHT_PX = 12.0


class MessageError(ValueError):
    """A message that is not what its topic is for; the text says why."""


class ResultMessages:
    """Makes messages of one library's classes.

    Parameters
    ----------
    types : mapping of str to type
        Classes by the names that `MESSAGE_TYPES` has; their fields have defaults, as ROS's have.
    as_bytes : callable
        Takes a 1-D uint8 array; returns what the library takes for a field ``uint8[]``.
    """

    def __init__(
        self, types: Mapping[str, Any], as_bytes: Callable[[NDArray[np.uint8]], Any]
    ) -> None:
        self._as_bytes = as_bytes
        self._types, self._marker, self._point = types, types["Marker"], types["Point"]
        color = types["ColorRGBA"]
        self._blue, self._red, self._yellow = (color(**c) for c in (_BLUE, _RED, _YELLOW))
        self._fields: dict[np.dtype, list[Message]] = {}

    def cloud(self, header: Message, rows: Rows) -> Message:
        """Return rows of a cloud as a message of one row; an empty one is a message, too.

        Parameters
        ----------
        header : std_msgs/Header
        rows : (N,) CLOUD_DTYPE or TRACK_CLOUD_DTYPE
        """
        # A view, not tobytes(): one copy less.
        pixels = np.ascontiguousarray(rows).view(np.uint8) if len(rows) else np.zeros(0, np.uint8)
        return self._types["PointCloud2"](
            header=header,
            height=1,
            width=len(rows),
            fields=self._point_fields(rows.dtype),
            is_bigendian=sys.byteorder == "big",
            point_step=rows.itemsize,
            row_step=rows.nbytes,
            data=self._as_bytes(pixels),
            is_dense=all(bool(np.isfinite(rows[axis]).all()) for axis in "xyz"),
        )

    def detections(self, header: Message, detections: Rows) -> Message:
        """Return the RSO detections of a frame (DETECTION_DTYPE) as ``rso_detections``.

        Confirmed ones bear their track's id, candidates 0.
        """
        return self.cloud(header, _cloud_of(detections, CLOUD_DTYPE, _DETECTION_FIELDS))

    def tracks(self, header: Message, tracks: Rows) -> Message:
        """Return the tracks of a frame (TRACK_DTYPE) as ``rso_tracks``, coasting ones included."""
        return self.cloud(header, _cloud_of(tracks, TRACK_CLOUD_DTYPE, _TRACK_FIELDS))

    def star_field_motion(self, header: Message, result: FrameResult | None) -> Message:
        """Return the motion of the star field: x, y px/s at the image's centre, z rad/s.

        NaN where it is unknown, or for a frame without a result.
        """
        message = self._types["Vector3Stamped"](header=header)
        rate = np.full(3, np.nan)
        if result is not None and result.star_field is not None:
            field = result.star_field
            rate = np.array([*field.displacement, field.rotation]) / result.dt_s
        message.vector.x, message.vector.y, message.vector.z = rate.tolist()
        return message

    def no_flow_markers(self, header: Message) -> Message:
        """Return the array that clears what the frame before has drawn."""
        return self._types["MarkerArray"](markers=[self._clear(header)])

    def flow_markers(self, header: Message, result: FrameResult, scale: float) -> Message:
        """Return what a frame shows, to be drawn over its image; coordinates are px, z is 0.

        Every array begins by deleting what was drawn before.  Namespaces: ``star_flow`` (blue)
        and ``rso_flow`` (red), each one LINE_LIST of vectors that begin where the object is and
        are one frame's displacement times `scale`; ``rso_boxes``, one marker per detection, closed
        around a confirmed RSO and only its corners around a candidate; ``coasting_boxes``
        (yellow), one per track that is only expected there; ``rso_ids``, one per confirmed RSO and
        coasting track.

        Parameters
        ----------
        header : std_msgs/Header
        result : FrameResult
        scale : float
            Length of a vector, in frames of motion.
        """
        stars, rows = result.star_rows, result.detections
        start, step = result.flow.position[stars], result.flow.displacement[stars]
        markers = [self._clear(header)]
        markers += self._vectors(header, "star_flow", self._blue, start, step * scale)
        start = np.column_stack([rows["x"], rows["y"]])
        step = np.column_stack([rows["vx"], rows["vy"]]) * result.dt_s
        markers += self._vectors(header, "rso_flow", self._red, start, step * scale)
        for number, row in enumerate(rows):
            confirmed = bool(row["status"] == CONFIRMED)
            markers.append(self._box(header, "rso_boxes", number, row, self._red, confirmed))
            if confirmed:
                label = f"{row['track_id']}  SNR {row['snr']:.0f}"
                markers.append(self._id(header, row, label, self._red))
        for row in result.tracks[result.tracks["status"] == COASTING]:
            number = int(row["track_id"])
            markers.append(self._box(header, "coasting_boxes", number, row, self._yellow, True))
            markers.append(self._id(header, row, f"{number}  coasting", self._yellow))
        return self._types["MarkerArray"](markers=markers)

    def _point_fields(self, dtype: np.dtype) -> list[Message]:
        if dtype not in self._fields:
            field = self._types["PointField"]
            self._fields[dtype] = [
                field(name=name, offset=offset, datatype=_POINT_TYPES[kind.str[1:]], count=1)
                for name, (kind, offset, *_) in (dtype.fields or {}).items()
            ]
        return self._fields[dtype]

    def _clear(self, header: Message) -> Message:
        marker = self._marker(header=header, action=self._marker.DELETEALL)
        marker.pose.orientation.w = 1.0
        return marker

    def _new(self, header: Message, namespace: str, number: int, kind: int, color: Any) -> Message:
        marker = self._marker(header=header, ns=namespace, id=number, type=kind, color=color)
        marker.pose.orientation.w = 1.0
        return marker

    def _lines(self, ends: NDArray[np.float64]) -> list[Message]:
        """Begins and ends of lines (N, 2), px."""
        point = self._point
        return [point(x=x, y=y) for x, y in ends.tolist()]

    def _vectors(
        self,
        header: Message,
        namespace: str,
        color: Message,
        start: NDArray[np.float64],
        step: NDArray[np.float64],
    ) -> list[Message]:
        """One LINE_LIST; none if there is no vector, which viewers complain about."""
        # What was only later found in a first frame has no frame before it to come from.
        known = np.isfinite(step).all(axis=1)
        if not known.any():
            return []
        marker = self._new(header, namespace, 0, self._marker.LINE_LIST, color)
        marker.scale.x = _LINE_WIDTH_PX
        ends = np.stack([start[known], (start + step)[known]], axis=1)
        marker.points = self._lines(ends.reshape(-1, 2))
        return [marker]

    def _box(
        self,
        header: Message,
        namespace: str,
        number: int,
        row: np.void,
        color: Message,
        closed: bool,
    ) -> Message:
        """A square around a place, or only its corners."""
        centre, half = np.array([row["x"], row["y"]]), _half_side(row)
        corners = centre + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        box = self._new(header, namespace, number, self._marker.LINE_LIST, color)
        box.scale.x = _LINE_WIDTH_PX
        ends = []
        for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            bit = _CORNER * (there - here)
            ends += [here, there] if closed else [here, here + bit, there - bit, there]
        box.points = self._lines(np.array(ends))
        return box

    def _id(self, header: Message, row: np.void, label: str, color: Message) -> Message:
        """A text over the box of what has an id."""
        number, kind = int(row["track_id"]), self._marker.TEXT_VIEW_FACING
        text = self._new(header, "rso_ids", number, kind, color)
        text.scale.z = _TEXT_HEIGHT_PX
        text.pose.position.x = float(row["x"])
        text.pose.position.y = float(row["y"]) - _half_side(row) - _TEXT_HEIGHT_PX / 2
        text.text = label
        return text


def cloud_rows(count: int, dtype: np.dtype = CLOUD_DTYPE) -> Rows:
    """Return `count` rows of a cloud in which everything is unknown."""
    rows = np.zeros(count, dtype)
    for name in dtype.names or ():
        if dtype[name].kind == "f":
            rows[name] = np.nan
    return rows


def detections_array(cloud: Message) -> Rows:
    """Return the detections of an ``rso_detections`` message as DETECTION_DTYPE.

    Columns that the message does not carry are NaN, rows of other arrays are -1.

    Raises
    ------
    MessageError
        If the message is no such cloud.
    """
    rows = _array_of(cloud, DETECTION_DTYPE, _DETECTION_FIELDS)
    rows["significance"] = np.nan
    rows["object_index"] = rows["flow_index"] = -1
    return rows


def tracks_array(cloud: Message) -> Rows:
    """Return the tracks of an ``rso_tracks`` message as TRACK_DTYPE.

    Columns that the message does not carry are NaN.

    Raises
    ------
    MessageError
        If the message is no such cloud.
    """
    rows = _array_of(cloud, TRACK_DTYPE, _TRACK_FIELDS)
    rows["log_false"] = np.nan
    return rows


def cloud_array(cloud: Message) -> Rows:
    """Return the points of any cloud as a structured array, one field per field.

    Raises
    ------
    MessageError
        If its fields, steps and data contradict each other.
    """
    order = ">" if cloud.is_bigendian else "<"
    try:
        dtype = np.dtype(
            {
                "names": [field.name for field in cloud.fields],
                "formats": [order + _DTYPES[field.datatype] for field in cloud.fields],
                "offsets": [field.offset for field in cloud.fields],
                "itemsize": cloud.point_step,
            }
        )
        return np.frombuffer(cloud.data, dtype, cloud.width * cloud.height)
    except (KeyError, ValueError, OverflowError) as error:
        raise MessageError(f"the cloud contradicts itself: {error}") from error


def _cloud_of(array: Rows, dtype: np.dtype, columns: Mapping[str, str]) -> Rows:
    """Rows of a cloud, of an array's columns; what the array does not hold is unknown."""
    rows = cloud_rows(len(array), dtype)
    for field, column in columns.items():
        rows[field] = array[column]
    for field, column in zip("xyz", array["sight"].T, strict=True):
        rows[field] = column
    return rows


def _array_of(cloud: Message, dtype: np.dtype, columns: Mapping[str, str]) -> Rows:
    """The array whose columns are a cloud's fields; MessageError if one is missing."""
    points = cloud_array(cloud)
    if missing := {*columns, *"xyz"} - set(points.dtype.names or ()):
        raise MessageError(f"the cloud has no field {', '.join(sorted(missing))}")
    rows = np.zeros(len(points), dtype)
    for field, column in columns.items():
        rows[column] = points[field]
    rows["sight"] = np.column_stack([points[axis] for axis in "xyz"])
    return rows


def _half_side(row: np.void) -> float:
    length = float(row["length"])
    return _BOX_MARGIN_PX + (0.0 if math.isnan(length) else length / 2)
