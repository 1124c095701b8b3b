# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The RViz view and the Foxglove layout name what the nodes really publish, over DDS."""

import json
import re
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from ros_graph import Graph, image, sky, without_rso
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image
from visualization_msgs.msg import MarkerArray

from ofsat_ros.nodes.detector import Detector
from ofsat_ros.nodes.messages import picture_array

DATA = resources.files("ofsat_ros") / "data"
RVIZ = yaml.safe_load((DATA / "ofsat.rviz").read_text())
FOXGLOVE = json.loads((DATA / "foxglove.json").read_text())

DISPLAYS = RVIZ["Visualization Manager"]["Displays"]
PANELS = FOXGLOVE["configById"]
# What RViz's displays and Foxglove's panels are there for.
DISPLAY_TYPES = {
    "rviz_default_plugins/Image": "sensor_msgs/msg/Image",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
}
WATCHED = {"/image_annotated", "/flow_markers", "/star_field_motion", "/diagnostics"}
PANEL_TYPES = {"Image", "3D", "Plot", "DiagnosticSummary", "DiagnosticStatusPanel"}


def panels(kind: str) -> list[dict[str, Any]]:
    return [about for name, about in PANELS.items() if name.partition("!")[0] == kind]


def plotted() -> list[str]:
    return [path["value"] for plot in panels("Plot") for path in plot["paths"]]


def foxglove_topics() -> dict[str, str]:
    """Topics of the layout, and what their panels expect there."""
    return {
        **{about["imageMode"]["imageTopic"]: "sensor_msgs/msg/Image" for about in panels("Image")},
        **{
            topic: "visualization_msgs/msg/MarkerArray"
            for about in panels("3D")
            for topic in about["topics"]
        },
        **{
            about["topicToRender"]: "diagnostic_msgs/msg/DiagnosticArray"
            for kind in ("DiagnosticSummary", "DiagnosticStatusPanel")
            for about in panels(kind)
        },
    }


@pytest.fixture(scope="module")
def graph():
    with Graph("-p", "reliable_input:=true") as graph:
        yield graph


@pytest.fixture(scope="module")
def detector(graph: Graph) -> Detector:
    return graph.add(Detector(context=graph.context))


@pytest.fixture(scope="module")
def topics(graph: Graph, detector: Detector) -> dict[str, list[str]]:
    """Topics that exist while a detector runs, and their types."""
    found: dict[str, list[str]] = {}

    def look() -> bool:
        found.update(graph.probe.get_topic_names_and_types())
        return "/diagnostics" in found

    graph.until(look)
    return found


@pytest.fixture(scope="module")
def heard(graph: Graph, detector: Detector) -> dict[str, list]:
    """What the detector publishes on each topic while an RSO comes, and hides at the end."""
    frames = sky(10)
    frames[8:] = map(without_rso, frames[8:])
    publishers = [about for about in detector.publishers if about.topic_name in WATCHED]
    messages = {one.topic_name: graph.listen(one.msg_type, one.topic_name) for one in publishers}
    camera = graph.publisher(Image, "image")
    graph.connect(camera, *publishers)
    for frame in frames:
        camera.publish(image(frame))
        graph.serve_once()
    last = frames[-1].stamp_ns

    def all_came() -> bool:
        pictures = messages["/image_annotated"]
        done = [array for array in messages["/diagnostics"] if f"{last}" in str(array.status)]
        return len(pictures) == len(frames) and bool(done)

    graph.until(all_came)
    return messages


@pytest.mark.parametrize("display", DISPLAYS, ids=[about["Name"] for about in DISPLAYS])
def test_rviz_displays_what_is_published_as_it_is_sent(
    display: dict, graph: Graph, topics: dict[str, list[str]]
):
    about = display["Topic"]
    assert topics[about["Value"]] == [DISPLAY_TYPES[display["Class"]]]
    wanted = QoSProfile(
        depth=about["Depth"],
        history=HistoryPolicy.get_from_short_key(
            about["History Policy"].lower().replace(" ", "_")
        ),
        reliability=ReliabilityPolicy.get_from_short_key(
            about["Reliability Policy"].lower().replace(" ", "_")
        ),
        durability=DurabilityPolicy.get_from_short_key(about["Durability Policy"].lower()),
        liveliness=LivelinessPolicy.AUTOMATIC,
    )
    (publisher,) = graph.probe.get_publishers_info_by_topic(about["Value"])
    compatible, why = qos_check_compatible(publisher.qos_profile, wanted)
    assert compatible == QoSCompatibility.OK, why


def test_rviz_shows_image_and_markers_and_needs_no_tf():
    assert {about["Class"] for about in DISPLAYS} == set(DISPLAY_TYPES)
    assert all(about["Enabled"] and about["Value"] for about in DISPLAYS)
    current = RVIZ["Visualization Manager"]["Transformation"]["Current"]
    assert current == {"Class": "rviz_common/Identity"}


def test_rviz_lists_the_namespaces_of_the_markers(heard: dict[str, list]):
    arrays: list[MarkerArray] = heard["/flow_markers"]
    drawn = {marker.ns for array in arrays for marker in array.markers if marker.ns}
    (display,) = (about for about in DISPLAYS if "Namespaces" in about)
    assert display["Namespaces"] == dict.fromkeys(drawn, True)


def test_rviz_looks_from_behind_the_sensor():
    """As `rviz_default_plugins/Orbit` places its camera: x to the right, y down."""
    view = RVIZ["Visualization Manager"]["Views"]["Current"]
    assert (view["Class"], view["Invert Z Axis"]) == ("rviz_default_plugins/Orbit", False)
    yaw, pitch = view["Yaw"], view["Pitch"]
    position = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
    forward = -np.array(position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    np.testing.assert_allclose(forward, [0, 0, 1], atol=0.002)
    np.testing.assert_allclose(right, [1, 0, 0], atol=0.002)
    np.testing.assert_allclose(np.cross(right, forward), [0, -1, 0], atol=0.002)


def test_foxglove_looks_from_behind_the_sensor():
    """As its 3D panel turns its camera, which without a turn looks down from z, y up."""
    (about,) = panels("3D")
    camera = about["cameraState"]
    turn = Rotation.from_euler("ZYX", [-camera["thetaOffset"], 0, camera["phi"]], degrees=True)
    np.testing.assert_allclose(turn.apply([0, 0, -1]), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(turn.apply([1, 0, 0]), [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(turn.apply([0, 1, 0]), [0, -1, 0], atol=1e-9)
    assert camera["perspective"]
    assert camera["near"] < camera["distance"] < camera["far"]


def test_foxglove_shows_each_panel_once():
    def leaves(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        assert part["direction"] in ("row", "column")
        assert 0 < part["splitPercentage"] < 100
        return [*leaves(part["first"]), *leaves(part["second"])]

    assert sorted(leaves(FOXGLOVE["layout"])) == sorted(PANELS)
    assert {name.partition("!")[0] for name in PANELS} == PANEL_TYPES


@pytest.mark.parametrize("topic", foxglove_topics())
def test_foxglove_names_topics_of_the_types_its_panels_show(
    topic: str, topics: dict[str, list[str]]
):
    assert topics[topic] == [foxglove_topics()[topic]]


def at_path(path: str, message: Any) -> list[Any]:
    """What a message path of Foxglove finds in a message: .field, [:] and {field=="value"}."""
    found = [message]
    steps = re.findall(r'\.(\w+)|(\[:\])|\{(\w+)=="(\w+)"\}', path)
    assert "".join(f".{f}" if f else a or f'{{{k}=="{v}"}}' for f, a, k, v in steps) == path
    for field, everything, key, value in steps:
        if field:
            found = [getattr(one, field) for one in found]
        elif everything:
            found = [one for some in found for one in some]
        else:
            found = [one for one in found if getattr(one, key) == value]
    return found


@pytest.mark.parametrize("path", plotted())
def test_foxglove_plots_numbers_that_are_there(path: str, heard: dict[str, list]):
    topic, _, rest = path.partition(".")
    found = [float(value) for message in heard[topic] for value in at_path("." + rest, message)]
    assert np.isfinite(found).any()


def test_foxglove_knows_the_detectors_status_by_its_name(heard: dict[str, list]):
    (about,) = panels("DiagnosticStatusPanel")
    arrays: list[DiagnosticArray] = heard["/diagnostics"]
    (named,) = {(one.name, one.hardware_id) for array in arrays for one in array.status}
    assert named == (about["selectedName"], about["selectedHardwareId"])


def test_the_annotated_image_shows_tail_and_pace(heard: dict[str, list]):
    """The tail of an RSO that crosses the image, red, and a line at the bottom, white."""
    picture = picture_array(heard["/image_annotated"][7]).astype(int)
    frame = sky(8)[7]
    zoom = picture.shape[0] // frame.image.shape[0]
    places = [(one.truth["x_px"][0], one.truth["y_px"][0]) for one in sky(8)[4:7]]
    for (x, y), (to_x, to_y) in pairwise(places):
        row, column = (round(zoom * (a + b) / 2) for a, b in ((y, to_y), (x, to_x)))
        near = picture[row - 4 : row + 5, column - 4 : column + 5]
        assert (near[..., 2] - near[..., 1] > 40).any()
    assert np.count_nonzero(picture[-22:].min(axis=2) > 200) > 100
