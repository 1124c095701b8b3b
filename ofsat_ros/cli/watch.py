# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""``ofsat watch``: the node of that name, for those who are on ssh without a screen."""

from __future__ import annotations

import importlib.util
import os
import re
import sys

import click

from ofsat_ros.cli.terminal import fail


@click.command("watch", epilog="Example: ofsat watch --namespace /east")
@click.option(
    "--namespace", default="/", metavar="NAME", help="of the detector, as its launch file was told"
)
def command(namespace: str) -> None:
    """Show the tracks and the health of a running detector, until Ctrl-C.

    A table that refreshes, for a terminal of 80 columns; a wider one shows more of each track.
    The same as `ros2 run ofsat_ros watch`.
    """
    if not re.fullmatch(r"/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*)?/?", namespace, re.ASCII):
        raise click.BadParameter(
            f"{namespace!r} is no namespace: names of letters, digits and _, between slashes",
            param_hint="--namespace",
        )
    if importlib.util.find_spec("rclpy") is None:
        fail(
            "watch listens to ROS 2, which is not here: `source /opt/ros/jazzy/setup.bash`, or"
            " `pip install 'ofsat_ros[ros]'`"
        )
    there = ["--ros-args", "-r", f"__ns:=/{namespace.strip('/')}"]
    # A node is a process: this one becomes it, and Ctrl-C reaches it alone.
    os.execv(sys.executable, [sys.executable, "-m", "ofsat_ros.nodes.start", "watch", *there])
