# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The launch files start executables that exist, with parameters that exist.

The wheels of ROS lack `launch`, so the files run with stand-ins that record what they ask for.
"""

import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ofsat_ros.camera import Camera
from ofsat_ros.nodes.recorder import HEARING
from ofsat_ros.parameters import (
    DetectorParameters,
    PlayerParameters,
    SimulatorParameters,
    preset_names,
)
from ofsat_ros.recordings import BagWriter, RecordingError
from ofsat_ros.simulation import SCENARIOS

ROOT = Path(__file__).parents[1]


class Asked:
    """Stands in for every class of `launch`, and keeps what it was made with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.kind = type(self).__name__
        self.args = args
        self.kwargs = kwargs
        self.name = args[0] if args else None

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


class Launch(ModuleType):
    """Stands in for every module of `launch`."""

    @staticmethod
    def get_package_share_directory(package: str) -> str:
        return f"/share/{package}"

    def __getattr__(self, name: str) -> type[Asked]:
        return type(name, (Asked,), {})


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that runs a launch file with arguments and returns what it asks for."""
    for name in ("actions", "event_handlers", "substitutions"):
        monkeypatch.setitem(sys.modules, f"launch.{name}", Launch(name))
    for name in ("actions", "parameter_descriptions"):
        monkeypatch.setitem(sys.modules, f"launch_ros.{name}", Launch(name))
    for name in ("launch", "launch_ros", "ament_index_python.packages"):
        monkeypatch.setitem(sys.modules, name, Launch(name))

    def run(name: str, **given: str) -> list[Asked]:
        file = runpy.run_path(f"{ROOT / 'launch' / name}")
        asked = file["generate_launch_description"]().args[0]
        arguments = {a.name: a.kwargs.get("default_value") for a in of_kind("Argument", asked)}
        assert given.keys() <= arguments.keys()
        for function in of_kind("OpaqueFunction", asked):
            asked += function.kwargs["function"]({**arguments, **given})
        return asked

    return run


def of_kind(kind: str, asked: list[Asked]) -> list[Asked]:
    return [one for one in asked if one.kind.endswith(kind)]


def only(kind: str, asked: list[Asked]) -> Asked:
    (one,) = of_kind(kind, asked)
    return one


def test_detector_is_left_as_it_is_without_arguments(launch: Any):
    node = only("Node", launch("detector.launch.py"))
    assert (node.kwargs["package"], node.kwargs["executable"]) == ("ofsat_ros", "detector")
    assert node.kwargs["parameters"] == [{}]
    assert node.kwargs["remappings"] == []


@pytest.mark.parametrize("name", ["detector", "guide"])
def test_what_dies_in_the_night_is_started_again_if_so_wanted(name: str, launch: Any):
    for wanted in (True, False):
        node = only("Node", launch(f"{name}.launch.py", respawn=str(wanted).lower()))
        # With the delay, what cannot start does not keep a processor busy.
        assert (node.kwargs["respawn"], node.kwargs["respawn_delay"]) == (wanted, 2.0)


def test_detector_takes_its_arguments(launch: Any):
    node = only(
        "Node",
        launch(
            "detector.launch.py",
            namespace="east",
            image="/cam/image_raw",
            camera_info="/cam/camera_info",
            attitude="/mount/attitude",
            image_transport="compressed",
            preset="paper_opencv",
            reliable_input="false",
            params_file="my.yaml",
        ),
    )
    assert node.kwargs["namespace"] == "east"
    # The later wins: what is said on the command line is said on purpose.
    file, parameters = node.kwargs["parameters"]
    assert file == "my.yaml"
    assert parameters == {
        "preset": "paper_opencv",
        "image_transport": "compressed",
        "reliable_input": False,
    }
    DetectorParameters.of(parameters)
    assert node.kwargs["remappings"] == [
        ("camera_info", "/cam/camera_info"),
        ("attitude", "/mount/attitude"),
        ("image", "/cam/image_raw"),
        ("image/compressed", "/cam/image_raw"),
    ]


def test_rviz_looks_at_the_detectors_topics_only_when_it_is_wanted(launch: Any):
    asked = launch("detector.launch.py", namespace="east", rviz="true")
    detector, rviz = of_kind("Node", asked)
    assert detector.kwargs["executable"] == "detector"
    assert (rviz.kwargs["package"], rviz.kwargs["executable"]) == ("rviz2", "rviz2")
    assert rviz.kwargs["namespace"] == "east"
    flag, view = rviz.kwargs["arguments"]
    assert (flag, view) == ("-d", "/share/ofsat_ros/config/ofsat.rviz")
    file = ROOT / "ofsat_ros" / "data" / Path(view).name
    named = re.findall(r"Value: (/\w+)", file.read_text())
    # Each topic of the view, within the namespace.
    assert rviz.kwargs["remappings"] == [(topic, topic.strip("/")) for topic in named]


def test_detector_offers_the_presets_there_are(launch: Any):
    arguments = {one.name: one for one in of_kind("Argument", launch("detector.launch.py"))}
    assert arguments["preset"].kwargs["choices"] == ["", *preset_names()]


def test_detector_sets_the_profile_that_is_installed(launch: Any):
    variable = only("SetEnvironmentVariable", launch("detector.launch.py"))
    name, value = variable.args
    assert name == value.name == "FASTRTPS_DEFAULT_PROFILES_FILE"
    profile = value.kwargs["default_value"]
    assert profile == "/share/ofsat_ros/config/fastdds_large_images.xml"
    assert (ROOT / "ofsat_ros" / "data" / Path(profile).name).is_file()


def test_simulation_starts_simulator_and_detector(launch: Any):
    asked = launch("simulation.launch.py")
    node = only("Node", asked)
    assert node.kwargs["executable"] == "simulator"
    # It ends, and with it all, when the simulator cannot start.
    assert (
        only("OnProcessExit", [only("RegisterEventHandler", asked).name]).kwargs["target_action"]
        is node
    )
    (scenario,) = (one for one in of_kind("Argument", asked) if one.name == "scenario")
    assert scenario.kwargs["choices"] == list(SCENARIOS)
    (parameters,) = node.kwargs["parameters"]
    table = SimulatorParameters()
    assert parameters == {name: getattr(table, name) for name in parameters}
    assert node.kwargs["remappings"] == []
    assert Path(only("IncludeLaunchDescription", asked).name).name == "detector.launch.py"


def test_simulator_publishes_where_the_detector_listens(launch: Any):
    given = {"namespace": "east", "image": "/cam"}
    simulator = only("Node", launch("simulation.launch.py", scenario="geo", seed="7", **given))
    detector = only("Node", launch("detector.launch.py", **given))
    assert simulator.kwargs["parameters"] == [{"scenario": "geo", "seed": 7, "rate": 1.0}]
    assert simulator.kwargs["namespace"] == detector.kwargs["namespace"] == "east"
    assert simulator.kwargs["remappings"] == [("image", "/cam")]
    assert ("image", "/cam") in detector.kwargs["remappings"]


@pytest.mark.parametrize("compressed", [False, True])
def test_replay_joins_player_and_detector_at_the_image_topic(
    launch: Any, tmp_path: Path, compressed: bool
):
    with BagWriter(tmp_path / "bag") as bag:
        sky = np.zeros((16, 16), np.uint8)
        bag.write_image("/cam/image_raw", sky, 1, "cam", compressed=compressed)
    asked = launch("replay.launch.py", bag=f"{tmp_path / 'bag'}", rate="2")

    player = only("Node", asked)
    assert player.kwargs["executable"] == "player"
    (parameters,) = player.kwargs["parameters"]
    assert parameters["bag"].kwargs == {"value_type": str}
    parameters["bag"] = parameters["bag"].name
    assert parameters["bag"] == f"{tmp_path / 'bag'}"
    assert parameters["topic"] == "/cam/image_raw"
    assert parameters["rate"] == 2.0
    PlayerParameters.of(parameters)

    detector = only("IncludeLaunchDescription", asked)
    assert Path(detector.name).name == "detector.launch.py"
    arguments = dict(detector.kwargs["launch_arguments"])
    assert arguments == {
        "image": "/cam/image_raw",
        "image_transport": "compressed" if compressed else "raw",
        "reliable_input": "true",
    }
    assert only("Node", launch("detector.launch.py", **arguments))

    assert only("OnProcessExit", [asked[-1].args[0]]).kwargs["target_action"] is player


def test_replay_joins_calibration_and_attitude_too(launch: Any, tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image("/cam/image_raw", np.zeros((16, 16), np.uint8), 1, "cam")
        bag.write_camera_info("/cam/camera_info", Camera.ideal(16, 16, 1e-4), 1, "cam")
        bag.write_attitude("/mount/attitude", Rotation.identity(), 1, "cam")
    asked = launch("replay.launch.py", bag=f"{tmp_path / 'bag'}")
    arguments = dict(only("IncludeLaunchDescription", asked).kwargs["launch_arguments"])
    assert arguments["camera_info"] == "/cam/camera_info"
    assert arguments["attitude"] == "/mount/attitude"
    assert only("Node", launch("detector.launch.py", **arguments))


def test_replay_says_which_image_topics_there_are(launch: Any, tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("/east", "/west"):
            bag.write_image(topic, np.zeros((16, 16), np.uint8), 1, "cam")
    with pytest.raises(RecordingError, match=r"/east \(1\), /west \(1\)"):
        launch("replay.launch.py", bag=f"{tmp_path / 'bag'}")


def test_replay_records_when_told_where(launch: Any, tmp_path: Path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write_image("/cam/image_raw", np.zeros((16, 16), np.uint8), 1, "cam")
    asked = launch("replay.launch.py", bag=f"{tmp_path / 'bag'}", record="20260401")
    recorder = only("Node", asked)
    assert recorder.kwargs["executable"] == "recorder"
    # The player is to start as soon as the recorder hears the detector, and not before.
    start = only("OnProcessIO", [one.name for one in of_kind("RegisterEventHandler", asked)])
    assert start.kwargs["target_action"] is recorder
    say = start.kwargs["on_stdout"]
    assert say(SimpleNamespace(text=b"recording")) is None
    (player,) = say(SimpleNamespace(text=f"{HEARING}\n".encode()))
    assert player.kwargs["executable"] == "player"
    (parameters,) = recorder.kwargs["parameters"]
    output = parameters["output"]
    assert (output.name, output.kwargs) == ("20260401", {"value_type": str})
    assert recorder.kwargs["namespace"].name == player.kwargs["namespace"].name == "namespace"
