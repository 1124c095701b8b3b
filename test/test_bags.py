# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The sample bags: the commands in their README still make what is in them."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from command import invoke

from ofsat_ros.recordings import open_recording
from ofsat_ros.simulation import TRUTH_DTYPE

BAGS = Path(__file__).parent.parent / "bags"
README = (BAGS / "README.md").read_text(encoding="utf-8")
COMMANDS = {
    match[1]: match[0]
    for match in re.finditer(r"^ofsat simulate -o bags/(\w+) .*$", README, re.MULTILINE)
}
DECIMALS = {"x_px": 4, "y_px": 4, "vx_px_s": 5, "vy_px_s": 5, "snr": 3, "flux": 2, "length_px": 3}
# 3 MB a bag, with its truth: what a clone may cost.
MOST_BYTES = 3_000_000


def frames_of(bag):
    with open_recording(bag) as recording:
        frames = list(recording)
        assert recording.problems == []
    return frames


def truth_of(bag):
    path = bag.with_name(bag.name + ".truth.csv")
    header = path.read_text(encoding="ascii").splitlines()[0]
    assert header == ",".join(TRUTH_DTYPE.names)
    return np.loadtxt(path, TRUTH_DTYPE, delimiter=",", skiprows=1, ndmin=1)


def size_of(bag):
    files = [*bag.iterdir(), bag.with_name(bag.name + ".truth.csv")]
    return sum(file.stat().st_size for file in files)


def test_every_bag_has_its_command_its_truth_and_its_row():
    bags = sorted(path.name for path in BAGS.iterdir() if path.is_dir())
    assert bags == sorted(COMMANDS) == ["geo", "sidereal", "survey", "survey_png"]
    for name in bags:
        assert f"| `{name}` |" in README
        assert size_of(BAGS / name) < MOST_BYTES


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_still_makes_the_same_content(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bags").mkdir()
    done = invoke(*shlex.split(COMMANDS[name])[1:])
    assert done.exit_code == 0, done.output
    kept, made = frames_of(BAGS / name), frames_of(tmp_path / "bags" / name)
    assert len(kept) == len(made) > 0
    assert [frame.stamp_ns for frame in kept] == [frame.stamp_ns for frame in made]
    for old, new in zip(kept, made, strict=True):
        assert old.frame_id == new.frame_id == "camera_optical_frame"
        assert old.image.dtype == new.image.dtype
        assert old.image.shape == new.image.shape
        # Machines differ in the last bits of erf and exp: at most a few pixels may round the
        # other way, by 1 DN.  Another stream of noise changes nearly all.
        difference = np.abs(old.image.astype(int) - new.image)
        assert difference.max() <= 1
        assert np.mean(difference > 0) < 0.001
    before, after = truth_of(BAGS / name), truth_of(tmp_path / "bags" / name)
    for column in TRUTH_DTYPE.names:
        # One unit of the last decimal that is written; counts and stamps have none.
        unit = 1.01 * 10.0 ** -DECIMALS[column] if column in DECIMALS else 0
        assert len(before) == len(after)
        assert np.abs(before[column] - after[column]).max() <= unit, column


@pytest.mark.parametrize("name", COMMANDS)
def test_truth_belongs_to_the_frames(name):
    frames, truth = frames_of(BAGS / name), truth_of(BAGS / name)
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert np.array_equal(truth["stamp_ns"], stamps[truth["frame"]])
    assert set(truth["frame"]) == set(range(len(frames)))
    seen = 0
    for row in truth[truth["snr"] > 15]:
        image = frames[row["frame"]].image.astype(float)
        x, y = round(row["x_px"]), round(row["y_px"])
        patch = image[y - 1 : y + 2, x - 1 : x + 2] - np.median(image)
        if x < 2 or y < 2 or patch.shape != (3, 3):
            continue
        noise = 1.4826 * np.median(np.abs(image - np.median(image)))
        # 3 x 3 pixels hold half or more of the light of a source of SNR 15 and a short streak:
        # about 9 of the noise of their sum.
        assert patch.sum() > 5 * 3 * noise, row
        seen += 1
    assert seen >= 35
