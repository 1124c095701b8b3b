"""ROS messages from and to the package's arrays: conversion, and nothing else.

It stands between the nodes and everything that runs without ROS.  Every message made here carries
the header it is given, so that a result bears its image's stamp and frame.
"""

from __future__ import annotations

import array
import math
import struct
import sys
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Vector3Stamped
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ofsat_ros.detection import CONFIRMED, DETECTION_DTYPE
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.tracking import COASTING, TRACK_DTYPE

_NS = 1_000_000_000
_STAMP_BYTES = 8

# Where the first header lies in a serialized message: after CDR's own header, and in an array
# after its length.
HEADER_AT, FIRST_MARKER_AT = 4, 8

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
    [(name, dtype) for name, (dtype, _) in CLOUD_DTYPE.fields.items()]
    + [(name, "f8") for name in ("sigma_u_rate", "sigma_v_rate", "age")]
    + [(name, "u4") for name in ("hits", "misses")],
    align=True,
)
_POINT_TYPES = {
    "i1": PointField.INT8,
    "u1": PointField.UINT8,
    "i2": PointField.INT16,
    "u2": PointField.UINT16,
    "i4": PointField.INT32,
    "u4": PointField.UINT32,
    "f4": PointField.FLOAT32,
    "f8": PointField.FLOAT64,
}
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

_BLUE = ColorRGBA(r=0.2, g=0.5, b=1.0, a=1.0)
_RED = ColorRGBA(r=1.0, g=0.15, b=0.1, a=1.0)
_YELLOW = ColorRGBA(r=1.0, g=0.85, b=0.2, a=1.0)
# px; half the side of the box around an RSO, beyond half its streak.
_BOX_MARGIN_PX = 8.0
# Part of a side that the corner of an open box is long.
_CORNER = 0.3
_LINE_WIDTH_PX = 1.0
_TEXT_HEIGHT_PX = 12.0


class MessageError(ValueError):
    """A message that is not what its topic is for; the text says why."""


def stamp_ns(stamp: Time) -> int:
    """Return a message's time in ns."""
    return stamp.sec * _NS + stamp.nanosec


def time_message(ns: int) -> Time:
    """Return a time in ns as a message."""
    return Time(sec=ns // _NS, nanosec=ns % _NS)


def header_stamp_ns(data: bytes | memoryview, header_at: int = HEADER_AT) -> int:
    """Return the stamp of a serialized message whose header lies at an offset, ns.

    Raises
    ------
    MessageError
        If the message ends before.
    """
    if len(data) < header_at + _STAMP_BYTES:
        raise MessageError(f"it has {len(data)} bytes, too few for a stamp")
    # The second byte tells the byte order of what follows.
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, header_at)
    return sec * _NS + nanosec


def image_message(header: Header, image: np.ndarray) -> Image:
    """Return an image as a message.

    Parameters
    ----------
    header : Header
    image : ndarray, shape (height, width) or (height, width, 3)
        uint8 or uint16; three channels are uint8 blue, green, red.
    """
    if image.ndim == 3:
        encoding = "bgr8"
    else:
        encoding = {"uint8": "mono8", "uint16": "mono16"}[image.dtype.name]
    return Image(
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=image[0].nbytes,
        data=_bytes_array(image),
    )


def cloud_rows(count: int, dtype: np.dtype = CLOUD_DTYPE) -> np.ndarray:
    """Return `count` rows of a cloud in which everything is unknown."""
    rows = np.zeros(count, dtype)
    for name in dtype.names:
        if dtype[name].kind == "f":
            rows[name] = np.nan
    return rows


def cloud_message(header: Header, rows: np.ndarray) -> PointCloud2:
    """Return rows of a cloud as a message of one row; an empty one is a message, too."""
    known = all(np.isfinite(rows[axis]).all() for axis in "xyz")
    return PointCloud2(
        header=header,
        height=1,
        width=len(rows),
        fields=_point_fields(rows.dtype),
        is_bigendian=sys.byteorder == "big",
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=_bytes_array(rows),
        is_dense=known,
    )


def detections_cloud(header: Header, detections: np.ndarray) -> PointCloud2:
    """Return the RSO detections of a frame (DETECTION_DTYPE) as ``rso_detections``.

    Confirmed ones bear their track's id, candidates 0.
    """
    return _cloud(header, detections, CLOUD_DTYPE, _DETECTION_FIELDS)


def tracks_cloud(header: Header, tracks: np.ndarray) -> PointCloud2:
    """Return the tracks of a frame (TRACK_DTYPE) as ``rso_tracks``, coasting ones included."""
    return _cloud(header, tracks, TRACK_CLOUD_DTYPE, _TRACK_FIELDS)


def detections_array(cloud: PointCloud2) -> np.ndarray:
    """Return the detections of an ``rso_detections`` message as DETECTION_DTYPE.

    Columns that the message does not carry are NaN, rows of other arrays are -1.

    Raises
    ------
    MessageError
        If the message is no such cloud.
    """
    rows = _rows(cloud, DETECTION_DTYPE, _DETECTION_FIELDS)
    rows["significance"] = np.nan
    rows["object_index"] = rows["flow_index"] = -1
    return rows


def tracks_array(cloud: PointCloud2) -> np.ndarray:
    """Return the tracks of an ``rso_tracks`` message as TRACK_DTYPE.

    Columns that the message does not carry are NaN.

    Raises
    ------
    MessageError
        If the message is no such cloud.
    """
    rows = _rows(cloud, TRACK_DTYPE, _TRACK_FIELDS)
    rows["log_false"] = np.nan
    return rows


def cloud_array(cloud: PointCloud2) -> np.ndarray:
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


def picture_array(message: Image) -> np.ndarray:
    """Return an annotated picture, shape (height, width, 3), uint8, as `image_message` sends it.

    Raises
    ------
    MessageError
        If it is another kind of image.
    """
    shape = (message.height, message.width, 3)
    whole = message.step == 3 * message.width and len(message.data) == math.prod(shape)
    if message.encoding != "bgr8" or not whole or not message.data:
        raise MessageError(f"the picture is not bgr8 without padding but {message.encoding!r}")
    return np.frombuffer(message.data, np.uint8).reshape(shape)


def no_flow_markers(header: Header) -> MarkerArray:
    """Return the array that clears what the frame before has drawn."""
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def flow_markers(header: Header, result: FrameResult, scale: float) -> MarkerArray:
    """Return what a frame shows, to be drawn over its image; coordinates are px, z is 0.

    Every array begins by deleting what was drawn before.  Namespaces: ``star_flow`` (blue) and
    ``rso_flow`` (red), each one LINE_LIST of vectors that begin where the object is and are one
    frame's displacement times `scale`; ``rso_boxes``, one marker per detection, closed around a
    confirmed RSO and only its corners around a candidate; ``coasting_boxes`` (yellow), one per
    track that is only expected there; ``rso_ids``, one per confirmed RSO and coasting track.

    Parameters
    ----------
    header : Header
    result : FrameResult
    scale : float
        Length of a vector, in frames of motion.
    """
    array_ = no_flow_markers(header)
    stars = result.star_rows
    start, step = result.flow.position[stars], result.flow.displacement[stars]
    array_.markers += _vectors(header, "star_flow", _BLUE, start, step * scale)
    rows = result.detections
    start = np.column_stack([rows["x"], rows["y"]])
    step = np.column_stack([rows["vx"], rows["vy"]]) * result.dt_s
    array_.markers += _vectors(header, "rso_flow", _RED, start, step * scale)
    for number, row in enumerate(rows):
        confirmed = row["status"] == CONFIRMED
        array_.markers.append(_box(header, "rso_boxes", number, row, _RED, confirmed))
        if confirmed:
            label = f"{row['track_id']}  SNR {row['snr']:.0f}"
            array_.markers.append(_id(header, row, label, _RED))
    for row in result.tracks[result.tracks["status"] == COASTING]:
        number = int(row["track_id"])
        array_.markers.append(_box(header, "coasting_boxes", number, row, _YELLOW, True))
        array_.markers.append(_id(header, row, f"{number}  coasting", _YELLOW))
    return array_


def star_field_vector(header: Header, result: FrameResult | None) -> Vector3Stamped:
    """Return the motion of the star field: x, y px/s at the image's centre, z rad/s.

    NaN where it is unknown, or for a frame without a result.
    """
    message = Vector3Stamped(header=header)
    rate = np.full(3, np.nan)
    if result is not None and result.star_field is not None:
        field = result.star_field
        rate = np.array([*field.displacement, field.rotation]) / result.dt_s
    message.vector.x, message.vector.y, message.vector.z = rate.tolist()
    return message


def diagnostic(
    name: str, problems: list[str], summary: str, values: Mapping[str, Any]
) -> DiagnosticStatus:
    """Return a status: WARN with the problems if there are any, else OK with the summary."""
    return DiagnosticStatus(
        level=DiagnosticStatus.WARN if problems else DiagnosticStatus.OK,
        name=name,
        message="; ".join(problems) or summary,
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
    )


def _cloud(
    header: Header, array_: np.ndarray, dtype: np.dtype, columns: Mapping[str, str]
) -> PointCloud2:
    """A cloud whose fields are an array's columns; what the array does not hold is unknown."""
    rows = cloud_rows(len(array_), dtype)
    for field, column in columns.items():
        rows[field] = array_[column]
    for field, column in zip("xyz", array_["sight"].T, strict=True):
        rows[field] = column
    return cloud_message(header, rows)


def _rows(cloud: PointCloud2, dtype: np.dtype, columns: Mapping[str, str]) -> np.ndarray:
    """The array whose columns are a cloud's fields; MessageError if one is missing."""
    points = cloud_array(cloud)
    if missing := {*columns, *"xyz"} - set(points.dtype.names or ()):
        raise MessageError(f"the cloud has no field {', '.join(sorted(missing))}")
    rows = np.zeros(len(points), dtype)
    for field, column in columns.items():
        rows[column] = points[field]
    rows["sight"] = np.column_stack([points[axis] for axis in "xyz"])
    return rows


@cache
def _point_fields(dtype: np.dtype) -> list[PointField]:
    return [
        PointField(name=name, offset=offset, datatype=_POINT_TYPES[kind.str[1:]], count=1)
        for name, (kind, offset) in dtype.fields.items()
    ]


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _bytes_array(pixels: np.ndarray) -> array.array:
    """Return an array's bytes as the one type that rclpy takes over without a loop."""
    data = array.array("B")
    # A view, not tobytes(): one copy less.  memoryview.cast refuses arrays without elements.
    if pixels.size:
        data.frombytes(memoryview(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)))
    return data


def _marker(header: Header, namespace: str, number: int, kind: int, color: ColorRGBA) -> Marker:
    marker = Marker(header=header, ns=namespace, id=number, type=kind, color=color)
    marker.pose.orientation.w = 1.0
    return marker


def _vectors(
    header: Header, namespace: str, color: ColorRGBA, start: np.ndarray, step: np.ndarray
) -> list[Marker]:
    """One LINE_LIST; none if there is no vector, which viewers complain about."""
    if not len(start):
        return []
    marker = _marker(header, namespace, 0, Marker.LINE_LIST, color)
    marker.scale.x = _LINE_WIDTH_PX
    ends = np.stack([start, start + step], axis=1).reshape(-1, 2)
    marker.points = [Point(x=x, y=y) for x, y in ends.tolist()]
    return [marker]


def _box(
    header: Header, namespace: str, number: int, row: np.void, color: ColorRGBA, closed: bool
) -> Marker:
    """A square around a place, or only its corners."""
    centre, half = np.array([row["x"], row["y"]]), _half_side(row)
    corners = centre + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    box = _marker(header, namespace, number, Marker.LINE_LIST, color)
    box.scale.x = _LINE_WIDTH_PX
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        bit = _CORNER * (there - here)
        ends = [here, there] if closed else [here, here + bit, there - bit, there]
        box.points += [Point(x=x, y=y) for x, y in np.array(ends).tolist()]
    return box


def _id(header: Header, row: np.void, label: str, color: ColorRGBA) -> Marker:
    """A text over the box of what has an id."""
    text = _marker(header, "rso_ids", int(row["track_id"]), Marker.TEXT_VIEW_FACING, color)
    text.scale.z = _TEXT_HEIGHT_PX
    text.pose.position.x = float(row["x"])
    text.pose.position.y = float(row["y"]) - _half_side(row) - _TEXT_HEIGHT_PX / 2
    text.text = label
    return text


def _half_side(row: np.void) -> float:
    return _BOX_MARGIN_PX + float(np.nan_to_num(row["length"])) / 2
