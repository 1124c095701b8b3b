# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""ROS messages from and to the package's arrays: conversion, and nothing else.

It stands between the nodes and everything that runs without ROS.  What results hold is said in
``results/messages.py``; here they are made of ROS's classes.
"""

from __future__ import annotations

import array
import math
import struct
import sys

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Vector3Stamped
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ofsat_ros.results.messages import (
    CLOUD_DTYPE,
    MessageError,
    ResultMessages,
    cloud_array,
    cloud_rows,
    detections_array,
    tracks_array,
)

__all__ = [
    "CLOUD_DTYPE",
    "FIRST_MARKER_AT",
    "HEADER_AT",
    "MessageError",
    "cloud_array",
    "cloud_message",
    "cloud_rows",
    "detections_array",
    "detections_cloud",
    "flow_markers",
    "header_stamp_ns",
    "image_message",
    "no_flow_markers",
    "picture_array",
    "stamp_ns",
    "star_field_vector",
    "time_message",
    "tracks_array",
    "tracks_cloud",
]

_NS = 1_000_000_000
_STAMP_BYTES = 8

# Where the first header lies in a serialized message: after CDR's own header, and in an array
# after its length.
HEADER_AT, FIRST_MARKER_AT = 4, 8


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


def _bytes_array(pixels: np.ndarray) -> array.array:
    """Return an array's bytes as the one type that rclpy takes over without a loop."""
    data = array.array("B")
    # A view, not tobytes(): one copy less.  memoryview.cast refuses arrays without elements.
    if pixels.size:
        data.frombytes(memoryview(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)))
    return data


_RESULTS = ResultMessages(
    {
        kind.__name__: kind
        for kind in (
            ColorRGBA,
            Marker,
            MarkerArray,
            Point,
            PointCloud2,
            PointField,
            Vector3Stamped,
        )
    },
    _bytes_array,
)
cloud_message = _RESULTS.cloud
detections_cloud, tracks_cloud = _RESULTS.detections, _RESULTS.tracks
star_field_vector = _RESULTS.star_field_motion
flow_markers, no_flow_markers = _RESULTS.flow_markers, _RESULTS.no_flow_markers
