# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""ROS messages made without ROS, by rosbags: their classes, and their bytes."""

from __future__ import annotations

from dataclasses import field, make_dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from ofsat_ros.recordings.bag import RecordingError, typestore

_NS = 1_000_000_000


@cache
def message_type(msgtype: str) -> Any:
    """Return the class of a type, as ``sensor_msgs/msg/Image``.

    A field that is not given is zero or empty, as in ROS; ``uint8[]`` and its like are numpy
    arrays.
    """
    base, fields = typestore().types[msgtype], typestore().fielddefs[msgtype][1]
    # rosbags' own want every field.
    return make_dataclass(
        base.__name__, [(name, Any, _field(*kind)) for name, kind in fields], bases=(base,)
    )


def header_message(stamp_ns: int, frame_id: str) -> Any:
    """Return a std_msgs/Header.

    Raises
    ------
    RecordingError
        If it cannot hold the stamp.
    """
    sec, nanosec = divmod(int(stamp_ns), _NS)
    if not 0 <= sec < 2**31:
        raise RecordingError(f"a header cannot hold the stamp {stamp_ns} ns")
    stamp = message_type("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
    return message_type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)


def serialized(message: Any) -> memoryview:
    """Return a message of a `message_type` as CDR."""
    return typestore().serialize_cdr(message, message.__msgtype__)


def _field(node: Nodetype, about: Any) -> Any:
    """What a class holds in a field when nothing is said."""
    if node == Nodetype.BASE:
        return field(default="" if about[0] == "string" else np.zeros((), about[0]).item())
    if node == Nodetype.NAME:
        return field(default_factory=message_type(about))
    (element, kind), count = about
    if element == Nodetype.BASE and kind[0] != "string":
        return field(default_factory=partial(np.zeros, count, kind[0]))
    return field(default_factory=list)  # of messages; there are none of a fixed length
