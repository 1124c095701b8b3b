# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Arrows point one way, and only nodes/ knows ROS."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import ofsat_ros

PACKAGE = Path(ofsat_ros.__file__).parent
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}
ROS = {"ament_index_python", "builtin_interfaces", "launch", "launch_ros", "rcl_interfaces"}
# In the order of the flow; history is what the last two share.
STAGES = {
    *("preprocessing", "objects", "optical_flow", "star_field"),
    *("history", "detection", "tracking"),
}
# What each part may import of the others; a module or a package of modules is a part.
ALLOWED = {
    "parameters": set(),
    "images": {"parameters"},
    "pixels": set(),
    "printing": set(),
    "timeline": set(),
    "parallel": set(),
    "preprocessing": {"parameters", "pixels", "parallel"},
    "objects": {"parameters", "pixels"},
    "optical_flow": {"parameters", "pixels"},
    "star_field": {"parameters", "optical_flow"},
    "history": {"pixels", "star_field"},
    "following": {"pixels", "history"},
    "detection": {
        *("parameters", "pixels", "parallel"),
        *("optical_flow", "star_field", "history", "following"),
    },
    "comoving": {"pixels", "history", "following", "detection"},
    "tracking": {"pixels", "history", "following", "detection"},
    "comparison": {"parameters", "optical_flow", "star_field"},
    "frame_result": STAGES - {"history"},
    "pipeline": {
        *("parameters", "pixels", "timeline"),
        *("comparison", "comoving", "frame_result", *STAGES),
    },
    "camera": {"parameters", "timeline"},
    "site": set(),
    "guidance": {"parameters", "camera", "timeline", "tracking"},
    "tracking_data": {"parameters", "timeline"},
    "recordings": {"images", "camera"},
    "simulation": {"parameters", "camera"},
    "results": {"parameters", "pipeline", "detection", "tracking", "recordings"},
    "processing": {
        *("parameters", "camera", "pipeline", "detection", "tracking"),
        *("recordings", "results", "tracking_data"),
    },
    "batch": {"processing", "recordings", "report", "results"},
    "suggestion": {"parameters", "camera", "pipeline", "recordings"},
    "evaluation": {"results"},
    "catalog": {"recordings", "results"},
    "report": {
        *("parameters", "camera", "pipeline", "detection", "tracking"),
        *("recordings", "results", "catalog"),
    },
}
# The two fronts use the rest, but not each other.
ALLOWED["cli"] = ALLOWED["nodes"] = set(ALLOWED)

Definition = ast.FunctionDef | ast.ClassDef


def imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield (module, name) of every import; the name is empty for `import module`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports are absolute here"
            yield from ((node.module or "", alias.name) for alias in node.names)


def imports_within(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield (part, name) of every import of this package's own parts."""
    for module, name in imports(tree):
        parents = module.split(".")
        if module == "ofsat_ros" and name and not name.startswith("__"):
            yield name, ""
        elif parents[0] == "ofsat_ros" and len(parents) > 1:
            yield parents[1], name


@pytest.fixture(params=FILES)
def file(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def tree(file: str) -> ast.Module:
    return ast.parse(FILES[file].read_text())


@pytest.fixture
def part(file: str) -> str:
    return file.partition("/")[0].removesuffix(".py")


def test_arrows_point_one_way(part: str, tree: ast.Module):
    found = {other for other, _ in imports_within(tree)} - {part}
    if part == "__init__":
        assert not found
    else:
        assert part in ALLOWED, f"say in this test what {part} may import"
        assert found <= ALLOWED[part]


def test_stages_share_data_but_do_not_call_each_other(part: str, tree: ast.Module):
    shared = {name for other, name in imports_within(tree) if other in STAGES - {part}}
    if part in STAGES:
        assert all(name[:1].isupper() for name in shared), "classes and dtypes only"


def test_nothing_private_crosses_a_border(part: str, tree: ast.Module):
    assert not [name for other, name in imports_within(tree) if other != part and name[:1] == "_"]


def test_only_nodes_import_ros(part: str, tree: ast.Module):
    roots = {module.partition(".")[0] for module, _ in imports(tree)}
    ros = {root for root in roots if root in ROS or root.startswith("rcl")}
    ros |= {root for root in roots if root.endswith(("_msgs", "_srvs"))}
    assert part == "nodes" or not ros


def test_names_say_what_is_inside(file: str):
    words = set(Path(file).with_suffix("").parts)
    assert not words & {"utils", "util", "helpers", "common", "misc"}


def public_definitions(tree: ast.Module | ast.ClassDef) -> Iterator[Definition]:
    for node in tree.body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
            if f"{node.name}.setter" not in decorators:  # its property has the docstring
                yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_definitions(node)


def test_what_is_public_is_documented(tree: ast.Module):
    assert ast.get_docstring(tree), "the module has no docstring"
    assert [node.name for node in public_definitions(tree) if not ast.get_docstring(node)] == []


# Each part is imported as the first one, in a process of its own; what they all use is there.
IMPORT_EACH = """
import importlib, importlib.abc, os, sys

class NoRos(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.startswith(("rcl", "launch", "ament")) or name.endswith(("_msgs", "_srvs")):
            raise ModuleNotFoundError(f"no {name} here", name=name)

sys.meta_path.insert(0, NoRos())
import cv2, numpy, rosbags.rosbag2, scipy.optimize, scipy.spatial.transform
for name in sys.argv[1:]:
    if not os.fork():
        assert importlib.import_module(name).__doc__
        sys.exit()
    if os.wait()[1]:
        sys.exit(f"importing {name} failed")
"""


def test_core_runs_without_ros():
    modules = ["ofsat_ros", *(f"ofsat_ros.{part}" for part in ALLOWED if part != "nodes")]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", IMPORT_EACH, *modules],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
