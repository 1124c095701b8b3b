# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Guidance: from tracks to the pointing offset of one target and a rate command for a mount.

Stands behind ``tracking``, like any other reader of ``rso_tracks``, and runs without ROS: a
`Guide` is fed the tracks of each frame and asked for a `Command` as often as a mount wants one.

Frames and signs: the optical frame (x right, y down, z forward).  An offset is the angle from the
boresight to the target, (right, down), rad.  A mount rate is the camera's angular velocity about
the optical axes relative to the stars, rad/s: about +y it turns the boresight to the right, about
+x upwards; zero is what a mount does that tracks the stars.

What the control law is (`pointing`): feed-forward of the target's own motion against the stars,
which our command does not change, so that there is no loop through it; and PI on the offset,
predicted by the motion of target and mount from the middle of the exposure to the moment at which
the command takes effect.  Which track is the target: `target`.
"""

from ofsat_ros.guidance.guide import Command, Guide

__all__ = ["Command", "Guide"]
