# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A release: wheel and sdist, their contents, and that they install; what bloom reads."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tarfile
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
from packaging.requirements import Requirement

import ofsat_ros

ROOT = Path(__file__).parents[1]
SAMPLE_BAG = "bags/survey_png"
BUILT = f"ofsat_ros-{ofsat_ros.__version__}"
# Keys of rosdep, looked up in ros/rosdistro as of 2026-08-22 (8468e88): its packages of Jazzy
# (jazzy/distribution.yaml), and rules that name an apt package for Ubuntu (rosdep/python.yaml).
JAZZY_KEYS = {
    *("ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs"),
    *("rcl_interfaces", "rclpy", "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs"),
    *("visualization_msgs", "launch", "launch_ros", "ros2launch"),
}
APT_KEYS = {
    *("python3-click", "python3-hypothesis", "python3-numpy", "python3-opencv"),
    *("python3-pytest", "python3-scipy", "python3-tqdm", "python3-yaml"),
}
# A rule that names a package of pip: rosdep installs it, bloom's build farm refuses it.
PIP_KEYS = {"python3-rosbags-pip"}


def run(*command: str | Path, cwd: Path) -> str:
    # As a user's shell is: nothing of this tree, nor of this environment.
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=cwd, env=clean, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def pip(*arguments: str | Path, cwd: Path) -> None:
    quiet = ("--quiet", "--disable-pip-version-check")
    run(sys.executable, "-m", "pip", *arguments, *quiet, "--no-index", "--no-deps", cwd=cwd)


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the sdist, and the wheel that is made of the sdist."""
    source = tmp_path_factory.mktemp("release") / "source"
    made = ("build", "install", "log", "*_output", "demo_report", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".*", *made))
    build = "import sys; from setuptools.build_meta import build_sdist; build_sdist(sys.argv[1])"
    folder = source.parent / "dist"
    run(sys.executable, "-c", build, folder, cwd=source)
    (sdist,) = folder.iterdir()
    pip("wheel", "--no-build-isolation", "--wheel-dir", folder, sdist, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    return dist / f"{BUILT}-py3-none-any.whl"


def needed(requirements: list[str], extra: str = "") -> Iterator[importlib.metadata.Distribution]:
    """Yield the distributions that some requirements ask for, here, and what they ask for."""
    for text in requirements:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            found = importlib.metadata.distribution(requirement.name)
            assert requirement.specifier.contains(found.version, prereleases=True), text
            yield found
            yield from needed(found.requires or [])


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new virtual environment with the wheel, what it asks for, and OpenCV; no more.

    What it asks for is not downloaded but linked to what this environment has.
    """
    folder = tmp_path_factory.mktemp("user") / "environment"
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    pip("--python", folder / "bin" / "python", "install", wheel, cwd=folder)
    (packages,) = folder.glob("lib/python3*/site-packages")
    (found,) = packages.glob("ofsat_ros-*.dist-info")
    for distribution in needed(importlib.metadata.Distribution.at(found).requires, "opencv"):
        for top in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
            if not top.endswith(".pth") and not (packages / top).exists():
                (packages / top).symlink_to(distribution.locate_file(top))
    return folder


def test_sdist_holds_what_a_release_needs(dist: Path) -> None:
    with tarfile.open(dist / f"{BUILT}.tar.gz") as archive:
        names = {name.removeprefix(f"{BUILT}/") for name in archive.getnames()}
    expected = {
        *("CHANGELOG.rst", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in", "README.md"),
        *("QUALITY_DECLARATION.md", "package.xml", "pyproject.toml", "setup.cfg", "setup.py"),
        *("resource/ofsat_ros", "launch/detector.launch.py"),
        *(f"{SAMPLE_BAG}/{file.name}" for file in (ROOT / SAMPLE_BAG).iterdir()),
    }
    assert expected <= names
    others = {name.partition("/")[0] for name in names - expected}
    assert others - {BUILT} <= {
        *("ofsat_ros", "ofsat_ros.egg-info", "launch", "resource", "bags", "PKG-INFO"),
    }


def test_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    package = {
        path.relative_to(ROOT).as_posix(): path.read_bytes()
        for path in (ROOT / "ofsat_ros").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {"ofsat_ros/presets/robust.yaml", "ofsat_ros/report/page/page.css"} <= set(package)
    inside = {name: data for name, data in contents.items() if name in package}
    assert inside == package
    apart = {name.partition("/")[0] for name in set(contents) - set(package)}
    assert apart == {f"{BUILT}.data", f"{BUILT}.dist-info"}
    # Older setuptools has it beside the metadata.
    (licence,) = (
        name for name in contents if re.search(r"\.dist-info/(licenses/)?LICENSE$", name)
    )
    assert contents[licence] == (ROOT / "LICENSE").read_bytes()
    assert f"{BUILT}.data/data/share/ofsat_ros/launch/detector.launch.py" in contents


def test_installed_ofsat_tells_its_version(environment: Path, tmp_path: Path) -> None:
    told = run(environment / "bin" / "ofsat", "--version", cwd=tmp_path)
    assert told.split()[-1] == ofsat_ros.__version__


def test_installed_ofsat_processes_the_installed_bag(environment: Path, tmp_path: Path) -> None:
    bag = environment / "share" / "ofsat_ros" / SAMPLE_BAG
    run(environment / "bin" / "ofsat", "process", bag, "-o", "out", cwd=tmp_path)
    head, *rows = (tmp_path / "out" / "tracks.csv").read_text().splitlines()
    assert "track_id" in head.split(",")
    assert len(rows) > 5
    # It ran what was installed, and knows that nothing makes a report there.
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.filterwarnings("ignore:nodes.Node.traverse:DeprecationWarning")
def test_changelog_is_one_that_bloom_reads(tmp_path: Path) -> None:
    text = (ROOT / "CHANGELOG.rst").read_text()
    assert text.splitlines()[0] == "Changelog for package ofsat_ros"
    # As catkin_prepare_release does it; bloom drops sections within a version.
    heading = f"{ofsat_ros.__version__} (2030-01-01)"
    text = text.replace("\nForthcoming\n-----------\n", f"\n{heading}\n{'-' * len(heading)}\n")
    (tmp_path / "CHANGELOG.rst").write_text(text)
    versions = list(get_changelog_from_path(tmp_path / "CHANGELOG.rst").foreach_version())
    assert versions[0][0] == ofsat_ros.__version__
    entries = [entry for _, _, (listed,) in versions for entry in listed.bullets]
    assert len(entries) == text.count("\n* ") > 30


def test_package_xml_is_one_that_bloom_takes() -> None:
    warnings: list[str] = []
    package = parse_package(ROOT, warnings=warnings)
    assert warnings == []
    assert package.licenses == ["Apache-2.0"]
    keys = {depend.name for depend in package.exec_depends + package.test_depends}
    assert keys == JAZZY_KEYS | APT_KEYS | PIP_KEYS


def test_versions_are_one() -> None:
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("version") == ofsat_ros.__version__
    others = [
        path.name
        for path in (ROOT / "setup.py", ROOT / "setup.cfg", ROOT / "pyproject.toml")
        if ofsat_ros.__version__ in path.read_text()
    ]
    assert others == [], "the version stands in ofsat_ros/__init__.py and package.xml alone"


def test_each_source_file_says_whose_it_is() -> None:
    line = re.compile(r"(#|//|/\*) Copyright 2026 .+; SPDX-License-Identifier: Apache-2.0\b")
    folders = ("ofsat_ros", "launch", "test", "benchmarks", "docs", ".ci")
    files = [ROOT / "setup.py", ROOT / ".ci" / "run"]
    files += [file for folder in folders for file in (ROOT / folder).rglob("*.*")]
    sources = [file for file in files if file.suffix in (".py", ".js", ".css", "")]
    assert len(sources) > 300
    for file in sources:
        # After what says how to run it.
        first = file.read_text().removeprefix("#!/usr/bin/env bash\n")
        assert line.match(first), f"{file} begins with no copyright statement"
