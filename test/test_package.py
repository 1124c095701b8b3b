# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The package as users get it: built by colcon, installed by pip, described by package.xml."""

import ast
import importlib.metadata
import os
import re
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.parameter_client import AsyncParameterClient

import ofsat_ros
from ofsat_ros.parameters import Parameters

ROOT = Path(__file__).parents[1]
NODES = {
    *("demo", "demo_guide", "detector", "guide", "player", "recorder", "simulator"),
    *("tdm_writer", "watch"),
}
# What Python imports under another name than rosdep or pip know it by.
ROSDEP_KEYS = {
    "click": "python3-click",
    "cv2": "python3-opencv",
    "hypothesis": "python3-hypothesis",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}
PIP_NAMES = {"yaml": "PyYAML"}
# What only some commands and tests need, and pip's extras bring: imported where it is used.
EXTRAS = {
    *("PIL", "astropy", "av", "ccsds_ndm", "erfa", "jinja2", "matplotlib", "mcap", "sgp4"),
    *("catkin_pkg", "dask", "distributed", "packaging", "psutil", "xsdata"),
}
DEADLINE_S = 30.0
SAMPLE_BAG = "bags/survey_png"


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def imported_packages(*folders: str) -> set[str]:
    """Return the packages from elsewhere that the Python files in some folders import."""
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    assert files
    names = set()
    for node in (node for file in files for node in ast.walk(ast.parse(file.read_text()))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    own = {"ofsat_ros", "benchmarks", *(file.stem for file in files)}
    return names - set(sys.stdlib_module_names) - own


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the package, since a build leaves files beside what it builds."""
    folder = tmp_path_factory.mktemp("source") / "ofsat_ros"
    folder.mkdir()
    for name in ("ofsat_ros", "launch", "resource", SAMPLE_BAG):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module", params=["copies", "symlinks"])
def installed(
    request: pytest.FixtureRequest, source: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return the prefix into which colcon has installed the package."""
    workspace = tmp_path_factory.mktemp(request.param)
    shutil.copytree(source, workspace / "src" / "ofsat_ros")
    search = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    colcon = shutil.which("colcon", path=search)
    assert colcon, "colcon is missing: pip install -e '.[test]', or apt has it"
    links = ["--symlink-install"] if request.param == "symlinks" else []
    run(colcon, "--log-base", "log", "build", *links, cwd=workspace)
    return workspace / "install" / "ofsat_ros"


def sourced(installed: Path) -> list[str | Path]:
    """Return what to put before a command for it to run after colcon's setup file."""
    return ["sh", "-c", '. "$0" && exec "$@"', installed.parent / "local_setup.sh"]


@pytest.fixture(scope="module")
def metadata(
    source: Path, tmp_path_factory: pytest.TempPathFactory
) -> importlib.metadata.Distribution:
    """Return what `pip install` into a fresh prefix tells of the package."""
    prefix = tmp_path_factory.mktemp("prefix")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    # Without --ignore-installed, pip would uninstall the package that it runs beside.
    elsewhere = ["--ignore-installed", "--no-deps", "--no-build-isolation", "--prefix", prefix]
    run(*pip, *elsewhere, source, cwd=prefix)
    (found,) = prefix.glob("lib/python3*/site-packages/ofsat_ros-*.dist-info")
    return importlib.metadata.Distribution.at(found)


def test_colcon_installs_share(installed: Path):
    expected = {
        "package.xml": ROOT / "package.xml",
        **{f"launch/{file.name}": file for file in (ROOT / "launch").glob("*.launch.py")},
        **{f"config/{file.name}": file for file in (ROOT / "ofsat_ros/presets").glob("*.yaml")},
        **{f"config/{file.name}": file for file in (ROOT / "ofsat_ros/data").iterdir()},
        **{f"{SAMPLE_BAG}/{file.name}": file for file in (ROOT / SAMPLE_BAG).iterdir()},
    }
    assert {"launch/detector.launch.py", "config/fastdds_large_images.xml"} <= set(expected)
    for name, original in expected.items():
        assert (installed / "share/ofsat_ros" / name).read_bytes() == original.read_bytes()


def test_setup_file_makes_the_package_known(installed: Path):
    script = """
from pathlib import Path
from ament_index_python.packages import get_package_share_directory
import ofsat_ros
print(get_package_share_directory("ofsat_ros"), Path(ofsat_ros.__file__).parents[1], sep="\\n")
"""
    output = run(*sourced(installed), sys.executable, "-c", script, cwd=installed)
    share, package = output.split()
    assert Path(share) == installed / "share/ofsat_ros"
    # With symlinks Python runs from the build folder, which links to the source.
    assert Path(package).is_relative_to(installed.parents[1])


def test_colcon_installs_what_ros2_run_finds(installed: Path):
    executables = installed / "lib" / "ofsat_ros"
    assert {path.name for path in executables.iterdir()} == {*NODES, "ofsat"}
    assert all(os.access(path, os.X_OK) for path in executables.iterdir())


@pytest.fixture
def detector(installed: Path) -> Iterator[subprocess.Popen]:
    """Start the installed detector in the environment that colcon's setup file makes."""
    name = ["--ros-args", "-r", "__node:=installed_detector", "-p", "threshold_sigmas:=5.5"]
    process = subprocess.Popen(
        [*sourced(installed), installed / "lib/ofsat_ros/detector", *name],
        cwd=installed,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    yield process
    process.kill()
    process.communicate()


def test_installed_detector_runs_until_interrupted(detector: subprocess.Popen):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("asking", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        client = AsyncParameterClient(node, "installed_detector")
        assert client.wait_for_services(DEADLINE_S), "the detector does not answer"
        # The detector may answer before it has discovered who asks, and then nobody hears it.
        for _ in range(10):
            asked = client.get_parameters(["threshold_sigmas", "min_area_px"])
            executor.spin_until_future_complete(asked, DEADLINE_S / 10)
            if asked.done():
                break
        values = asked.result().values
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert values[0].double_value == 5.5
    assert values[1].integer_value == Parameters().min_area_px

    detector.send_signal(signal.SIGINT)
    output, _ = detector.communicate(timeout=DEADLINE_S)
    assert detector.returncode == 0, output
    assert "Traceback" not in output


def test_installed_demo_plays_the_installed_bag(installed: Path, tmp_path: Path):
    demo = subprocess.Popen(
        [*sourced(installed), installed / "lib/ofsat_ros/demo"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        first = demo.stdout.readline()
        demo.send_signal(signal.SIGINT)
        rest, _ = demo.communicate(timeout=DEADLINE_S)  # ends when its children have, too
    finally:
        demo.kill()
        demo.stdout.close()
        demo.wait()
    assert first.startswith("demo: "), first + rest
    bag = Path(first.rpartition(" in ")[2].strip())
    # With symlinks the build folder, from which Python runs, has it as well.
    assert bag.is_relative_to(installed.parents[1])
    assert bag.match(SAMPLE_BAG)
    assert demo.returncode == 130, rest


def test_pip_installs_the_sample_bag_too(metadata: importlib.metadata.Distribution):
    installed = {path.as_posix().rpartition("share/")[2] for path in metadata.files}
    for file in (ROOT / SAMPLE_BAG).iterdir():
        assert f"ofsat_ros/{SAMPLE_BAG}/{file.name}" in installed


def test_pip_installs_the_same_commands(metadata: importlib.metadata.Distribution):
    commands = {entry.name: entry.value for entry in metadata.entry_points}
    assert commands == {
        "ofsat": "ofsat_ros.cli:main",
        **{node: f"ofsat_ros.nodes.start:{node}" for node in NODES},
    }
    assert all(callable(entry.load()) for entry in metadata.entry_points)


def test_pip_installs_package_data(metadata: importlib.metadata.Distribution):
    package = Path(metadata.locate_file("ofsat_ros"))
    for folder in ("presets", "data"):
        originals = {path.name for path in (ROOT / "ofsat_ros" / folder).iterdir()}
        assert {path.name for path in (package / folder).iterdir()} == originals


def test_plain_install_leaves_ros_and_opencv_alone(metadata: importlib.metadata.Distribution):
    plain = [text for text in metadata.requires or [] if "extra ==" not in text]
    assert "rosbags>=0.11.9" in [text.replace(" ", "") for text in plain]
    assert not [text for text in plain if text.startswith(("ros-", "opencv"))]


def test_plain_install_and_ros_extra_bring_what_is_imported(
    metadata: importlib.metadata.Distribution,
):
    requires = metadata.requires or []
    names = {text.partition(";")[0].partition(">")[0].strip() for text in requires}
    pure = {name for name in imported_packages("ofsat_ros") if name in ROSDEP_KEYS} - {"cv2"}
    assert {PIP_NAMES.get(name, name) for name in pure} <= names
    assert "opencv-python-headless" in names


def test_versions_agree(metadata: importlib.metadata.Distribution):
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("version") == ofsat_ros.__version__ == metadata.version


def test_package_xml_names_what_is_imported():
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("export/build_type") == "ament_python"
    needed = {element.text for element in package.findall("exec_depend")}
    imported = imported_packages("ofsat_ros", "launch") - EXTRAS
    # ros2launch is the command, which nothing imports.
    assert needed == {ROSDEP_KEYS.get(name, name) for name in imported} | {"ros2launch"}

    needed |= {element.text for element in package.findall("test_depend")}
    assert {ROSDEP_KEYS.get(name, name) for name in imported_packages("test") - EXTRAS} <= needed


def test_contributing_names_files_that_exist():
    table = [
        line.split("|")[1]
        for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines()
        if line.startswith("| `")
    ]
    named = {name.rstrip("/") for cell in table for name in re.findall(r"`(.+?)`", cell)}
    missing = [name for name in sorted(named) if not (ROOT / "ofsat_ros" / name).exists()]
    assert not missing
    parts = {path.name for path in (ROOT / "ofsat_ros").iterdir()}
    assert named == parts - {"__init__.py", "__pycache__"}
