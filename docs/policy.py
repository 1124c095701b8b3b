# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Make the SROS 2 policy: exactly the topics and services that each node has.

``python docs/policy.py`` starts every node, each alone, asks it what it has, and rewrites
``ofsat_ros/data/sros2_policy.xml``; ``test/test_security.py`` says when that is due.
"""

from __future__ import annotations

import io
import os
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from rclpy.context import Context
from rclpy.node import Node

from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.guide import GuideNode
from ofsat_ros.nodes.player import Player
from ofsat_ros.nodes.recorder import Recorder
from ofsat_ros.nodes.simulator import Simulator
from ofsat_ros.nodes.tdm_writer import TdmWriter
from ofsat_ros.nodes.watch import Watch
from ofsat_ros.recordings import BagWriter
from ofsat_ros.simulation import scenario

POLICY = Path(__file__).parent.parent / "ofsat_ros" / "data" / "sros2_policy.xml"
# In it, names are told apart that follow a node into its namespace, and those that don't.
_NAMESPACE = "/somewhere"
_COMMENT = """
  What each node of ofsat_ros may do under SROS 2, and nothing else: docs/security.md.
  Made by docs/policy.py from the nodes themselves.  Names are relative to the profile's ns: for
  nodes in a namespace, change that; for a topic that is remapped, its name.
"""
# Element of a policy, the one within it, and what a node does with that.
_RIGHTS = {
    "publish": ("topics", "topic"),
    "subscribe": ("topics", "topic"),
    "reply": ("services", "service"),
    "request": ("services", "service"),
}
_RECORDED = ("image", "image/compressed", "camera_info", "attitude")
_SIM_TIME = ("-p", "use_sim_time:=true")

# Names of topics and services by right, as a policy has them: relative, ~/private or /global.
Rights = Mapping[str, frozenset[str]]


def rights_of_all() -> dict[str, Rights]:
    """Start each node in every way that gives it other topics; return what it has.

    The last is no node but who operates them: he hears what they say, and calls their services.
    """
    with TemporaryDirectory(prefix="policy_") as folder:
        bag = f"{folder}/bag"
        _write_bag(bag)
        # A bag's topics are played as recorded, which is not in this namespace.
        here = [word for name in _RECORDED for word in ("-r", f"/{name}:={name}")]
        ways: dict[str, tuple[Callable[..., Node], Sequence[Sequence[str]]]] = {
            "detector": (
                lambda stop, context: Detector(context),
                [
                    ("-p", "image_transport:=raw", *_SIM_TIME),
                    ("-p", "image_transport:=compressed", *_SIM_TIME),
                ],
            ),
            "guide": (lambda stop, context: GuideNode(context), [_SIM_TIME]),
            "tdm_writer": (
                lambda stop, context: TdmWriter(context),
                [("-p", f"output:={folder}/tracks", *_SIM_TIME)],
            ),
            "recorder": (Recorder, [("-p", f"output:={folder}/results", *_SIM_TIME)]),
            "watch": (lambda stop, context: Watch(stop, io.StringIO(), context), [_SIM_TIME]),
            "player": (lambda stop, context: Player(stop, bag, context), [here]),
            "simulator": (
                Simulator,
                [("-p", "scenario:=sidereal"), ("-p", "scenario:=guide_drift")],
            ),
        }
        found = {name: rights(make, arguments) for name, (make, arguments) in ways.items()}
    return {**found, "operator": _of_operator(found)}


def rights(make: Callable[..., Node], ways: Sequence[Sequence[str]]) -> Rights:
    """Start a node with each of several ROS arguments; return what it has in any of them."""
    found: dict[str, frozenset[str]] = dict.fromkeys(_RIGHTS, frozenset())
    for arguments in ways:
        context, stop = Context(), threading.Event()
        context.init(args=["policy", "--ros-args", "-r", f"__ns:={_NAMESPACE}", *arguments])
        node = make(stop, context=context)
        try:
            for right, names in _seen(node).items():
                found[right] |= names
        finally:
            stop.set()
            node.close()
            node.destroy_node()
            context.try_shutdown()
    return found


def _seen(node: Node) -> Rights:
    """Return what a node sees of itself in the graph."""
    name, namespace = node.get_name(), node.get_namespace()
    asked = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return {
        right: frozenset(_relative(topic, name) for topic, _ in ask(name, namespace))
        for right, ask in asked.items()
    }


def _relative(topic: str, node: str) -> str:
    own, beside = f"{_NAMESPACE}/{node}/", f"{_NAMESPACE}/"
    if topic.startswith(own):
        return f"~/{topic.removeprefix(own)}"
    return topic.removeprefix(beside)


def _of_operator(found: Mapping[str, Rights]) -> Rights:
    logs = frozenset({"/parameter_events", "/rosout"})
    return {
        "publish": logs,
        "subscribe": frozenset().union(*(each["publish"] for each in found.values())),
        "reply": frozenset(),
        "request": frozenset(
            service.replace("~", node) for node, each in found.items() for service in each["reply"]
        ),
    }


def text(found: Mapping[str, Rights]) -> str:
    """Return the policy, version 0.2.0 as sros2 reads it: one enclave a node."""
    root = ET.Element("policy", version="0.2.0")
    root.append(ET.Comment(_COMMENT))
    enclaves = ET.SubElement(root, "enclaves")
    for node, of_node in found.items():
        enclave = ET.SubElement(enclaves, "enclave", path=f"/ofsat/{node}")
        profile = ET.SubElement(ET.SubElement(enclave, "profiles"), "profile", ns="/", node=node)
        for right, names in of_node.items():
            if names:
                several, one = _RIGHTS[right]
                expressions = ET.SubElement(profile, several, {right: "ALLOW"})
                for name in sorted(names):
                    ET.SubElement(expressions, one).text = name
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, "unicode")}\n'


def _write_bag(path: str) -> None:
    """Write a bag with all that a player plays."""
    sky = scenario("sidereal", 1, width=64, height=48, star_count=5)
    frame = sky.frame()
    stamp_ns = frame.stamp_ns
    with BagWriter(path) as bag:
        bag.write_image("/image", frame.image, stamp_ns, "camera")
        bag.write_image("/image/compressed", frame.image, stamp_ns, "camera", compressed=True)
        bag.write_camera_info("/camera_info", sky.camera, stamp_ns, "camera")
        bag.write_attitude("/attitude", frame.attitude, stamp_ns, "camera")


def main() -> None:
    """Write the policy."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    POLICY.write_text(text(rights_of_all()))


if __name__ == "__main__":
    main()
