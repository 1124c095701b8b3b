# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Which kind of recording is at a path, what is left out of it, and what is said of it."""

import shutil

import numpy as np
import pytest
from astropy.io import fits
from recorded import simple_bag

from ofsat_ros.recordings import (
    BagWriter,
    RecordingError,
    TopicError,
    open_recording,
    utc_ns,
    utc_text,
)

NS = 1_000_000_000


def night(folder, count=2, second=0):
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        header = fits.Header({"DATE-OBS": f"2026-01-01T00:00:{second + number:02}", "EXPTIME": 1})
        pixels = np.full((20, 30), number, np.uint16)
        fits.writeto(folder / f"light_{number}.fits", pixels, header)
    return folder


def test_of_a_folder_of_folders_those_with_recordings_are_told(tmp_path):
    night(tmp_path / "LIGHT", 3)
    night(tmp_path / "calibration" / "DARK", 1)
    simple_bag(tmp_path / "bag")
    (tmp_path / ".trash").mkdir()
    shutil.copy(tmp_path / "LIGHT" / "light_0.fits", tmp_path / ".trash")
    with pytest.raises(RecordingError) as said:
        open_recording(tmp_path)
    assert f"{said.value}" == (
        f"{tmp_path} holds no recording itself, but folders in it do: give one of them, or several"
        f" of one kind: {tmp_path}/LIGHT (3 FITS files), {tmp_path}/bag (a bag),"
        f" {tmp_path}/calibration/DARK (1 FITS file)"
    )


def test_what_is_beside_the_files_read_is_said(tmp_path):
    folder = night(tmp_path / "night")
    shutil.copytree(simple_bag(tmp_path / "bag"), folder, dirs_exist_ok=True)
    with open_recording(folder) as recording:
        assert (recording.kind, len(recording)) == ("rosbag2", 3)
        (said,) = recording.problems
    assert said == f"not read, as they are beside the bag files of {folder}: 2 FITS files"
    with open_recording(folder.glob("*.fits")) as recording:
        assert (recording.kind, len(recording)) == ("FITS", 2)
        assert "not read" not in " ".join(recording.problems)


def test_files_of_the_same_kind_in_folders_below_are_said(tmp_path):
    folder = night(tmp_path / "night")
    night(folder / "later", 3, 10)
    (folder / "results").mkdir()
    with open_recording(folder) as recording:
        assert len(recording) == 2
        said = recording.problems[-1]
    assert said.endswith(f"beside the FITS files of {folder}: 3 FITS files in {folder}/later")


def test_hidden_files_folders_and_links(tmp_path):
    folder = night(tmp_path / "night")
    (folder / "._light_0.fits").write_bytes(b"\0\5\x16\7")
    (folder / "gone.fits").symlink_to(folder / "nowhere")
    (folder / "results.fits").mkdir()
    night(tmp_path / "other", 1, 30)
    (folder / "link.fits").symlink_to(tmp_path / "other" / "light_0.fits")
    (folder / "again.fits").symlink_to(folder / "light_0.fits")
    with open_recording(folder) as recording:
        assert len(list(recording)) == 3
        assert recording.skipped == 1
        said = recording.problems[-1]
    assert said.endswith("gone.fits cannot be read: No such file or directory")


@pytest.mark.parametrize("inside", [[], [".hidden"]])
def test_an_empty_folder_is_called_empty(tmp_path, inside):
    for name in inside:
        (tmp_path / name).write_text("")
    with pytest.raises(RecordingError, match="is empty: there is nothing to read"):
        open_recording(tmp_path)


def test_what_has_to_be_converted_is_said(tmp_path):
    (tmp_path / "light.xisf").write_bytes(b"XISF0100")
    with pytest.raises(RecordingError, match=r"it holds light.xisf; .* converted to FITS first"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match=r"known here: .* converted to FITS first"):
        open_recording(tmp_path / "light.xisf")


def test_solved_files_of_another_name_are_known_by_their_content(tmp_path):
    folder = night(tmp_path / "night")
    for file in list(folder.iterdir()):
        file.rename(file.with_suffix(".new"))
    with open_recording(folder) as recording:
        assert (recording.kind, len(recording)) == ("FITS", 2)


def test_a_rate_or_begin_is_refused_for_a_bag(tmp_path):
    path = simple_bag(tmp_path / "bag")
    with pytest.raises(RecordingError, match=r"have stamps: --start and --fps 2 is of no use"):
        open_recording(path, fps=2, start_ns=NS)


def test_bags_whose_topics_differ_are_no_series(tmp_path):
    first = simple_bag(tmp_path / "first")
    with BagWriter(tmp_path / "second") as bag:
        bag.write_image("/other/image", np.zeros((20, 30), np.uint16), NS, "optical")
    with pytest.raises(
        RecordingError,
        match=r"are on /other/image, and .* on /camera/image_raw: give one recording",
    ):
        open_recording([tmp_path / "second", first])
    with BagWriter(tmp_path / "both") as bag:
        for topic in ("/a/image", "/b/image"):
            bag.write_image(topic, np.zeros((20, 30), np.uint16), NS, "optical")
    with pytest.raises(TopicError, match="several image topics") as said:
        open_recording(tmp_path / "both")
    assert {name: about.count for name, about in said.value.topics.items()} == {
        "/a/image": 1,
        "/b/image": 1,
    }


@pytest.mark.parametrize(
    ("text", "ns", "again"),
    [
        ("2026-03-01T22:15:00Z", 1_772_403_300 * NS, "2026-03-01T22:15:00Z"),
        ("2026-03-01 22:15", 1_772_403_300 * NS, "2026-03-01T22:15:00Z"),
        ("2026-03-01T23:45:00.5+01:30", 1_772_403_300 * NS + NS // 2, "2026-03-01T22:15:00.5Z"),
        ("2026-03-01T17:15:00-0500", 1_772_403_300 * NS, "2026-03-01T22:15:00Z"),
        ("1970-01-01T00:00:00.123456789987", 123_456_789, "1970-01-01T00:00:00.123456789Z"),
    ],
)
def test_instants_are_read_and_written(text, ns, again):
    assert utc_ns(text) == ns
    assert utc_text(ns) == again


@pytest.mark.parametrize(
    "text",
    [
        "",
        "tonight",
        "22:15",
        "2026-03-01",
        "2026-13-01T00:00",
        "2026-03-01T25:00",
        "1960-01-01T00:00",
    ],
)
def test_what_is_no_instant_is_refused(text):
    with pytest.raises(ValueError, match=r"is no date and time|not within the years"):
        utc_ns(text)
