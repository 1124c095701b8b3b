# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Torn and damaged bags give every message that is whole, and say what is not."""

import re
import resource
import shutil
import sqlite3
from itertools import pairwise

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded import (
    FRAME_ID,
    JAZZY,
    TOPIC,
    cdr_of,
    stamp_of,
    write_bag,
    write_mcap,
    write_ros1,
)
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from ofsat_ros.recordings import IMAGE, Bag, BagWriter, RecordingError, open_recording

COUNT = 30
NUMBERS = range(COUNT)
CHUNK, MESSAGES_IN_CHUNK = 20_000, 5
CUTS, MANY_CUTS = 40, 200
# What recorders of today write by default.
COMMON = ("mcap records", "mcap chunks", "sqlite")
ZSTD = re.escape(b"\x28\xb5\x2f\xfd")  # how its frames begin
ORIGINAL = {stamp_of(n): cdr_of(n) for n in NUMBERS}

# What writes COUNT messages into a file of each kind; names are those of the tests.
KINDS = {
    "mcap records": lambda path: write_mcap(path / "bag.mcap", NUMBERS, use_chunking=False),
    "mcap chunks": lambda path: write_mcap(path / "bag.mcap", NUMBERS, chunk_size=CHUNK),
    "mcap lz4": lambda path: write_mcap(path / "bag.mcap", NUMBERS, "LZ4", chunk_size=CHUNK),
    "mcap zstd": lambda path: write_mcap(path / "bag.mcap", NUMBERS, "ZSTD", chunk_size=CHUNK),
    "mcap messages zstd": lambda path: write_bag(path / "bag", NUMBERS, compression="message"),
    "sqlite": lambda path: write_bag(path / "bag", NUMBERS, storage="sqlite3"),
    "sqlite messages zstd": lambda path: write_bag(
        path / "bag", NUMBERS, storage="sqlite3", compression="message"
    ),
    "ros1": lambda path: write_ros1(path / "old.bag", NUMBERS, chunk_bytes=CHUNK),
    "ros1 lz4": lambda path: write_ros1(path / "old.bag", NUMBERS, "lz4", CHUNK),
    "ros1 bz2": lambda path: write_ros1(path / "old.bag", NUMBERS, "bz2", CHUNK),
}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def whole(kind, tmp_path_factory):
    """Return a whole file of the kind, which nothing is beside."""
    file = KINDS[kind](tmp_path_factory.mktemp("whole"))
    return shutil.move(file, tmp_path_factory.mktemp("bare") / file.name)


@pytest.fixture(scope="module")
def ends(kind, whole):
    """Return the byte after each message, by its stamp, as others' libraries tell."""
    data = whole.read_bytes()
    if kind in ("mcap lz4", "mcap zstd"):
        with whole.open("rb") as file:
            chunks = make_reader(file).get_summary().chunk_indexes
        assert len(chunks) > 5
        return {
            stamp: chunk.chunk_start_offset + chunk.chunk_length
            for chunk in chunks
            for stamp in ORIGINAL
            if chunk.message_start_time <= stamp <= chunk.message_end_time
        }
    if kind in ("ros1 lz4", "ros1 bz2"):
        with Rosbag1Reader(whole) as reader:
            assert len(reader.chunks) > 5
            ends = {at: chunk.datapos + chunk.datasize for at, chunk in reader.chunks.items()}
            (index,) = reader.indexes.values()
            return {entry.time: ends[entry.chunk_pos] for entry in index}
    reader = Rosbag1Reader(whole) if kind == "ros1" else Rosbag2Reader(whole)
    with reader:
        raw = {received: bytes(message) for _, received, message in reader.messages()}
    assert all(data.count(message[-12:]) == 1 for message in raw.values())
    last = {stamp: data.index(message[-12:]) + 12 for stamp, message in raw.items()}
    if not kind.startswith("sqlite"):
        return last
    first = {stamp: data.index(message[:64]) for stamp, message in raw.items()}
    return {stamp: _page_after(max(first[stamp], last[stamp])) for stamp in raw}


def _page_after(at):
    return -(-at // 4096) * 4096


def given_by(path):
    """Return time received and bytes of all messages, and the problems."""
    with Bag(path) as bag:
        messages = list(bag.messages([TOPIC]))
        assert len(bag.problems) == len(set(bag.problems))
        return {received: bytes(data) for _, _, received, data in messages}, bag.problems


def given_or_nothing(path):
    try:
        return given_by(path)
    except RecordingError as error:
        return {}, [f"{error}"]


def assert_messages_are_the_original(given):
    assert list(given) == sorted(given)
    for stamp, data in given.items():
        if data == ORIGINAL[stamp]:
            continue
        # Of ROS 1, what is between the fields may differ.
        image = JAZZY.deserialize_cdr(data, IMAGE)
        original = JAZZY.deserialize_cdr(ORIGINAL[stamp], IMAGE)
        np.testing.assert_array_equal(image.data, original.data)


def test_a_whole_file_is_given_without_a_word(whole):
    given, problems = given_by(whole)
    assert_messages_are_the_original(given)
    assert len(given) == COUNT
    assert problems == []


def test_a_file_cut_anywhere_gives_what_is_before_the_cut(kind, whole, ends, tmp_path):
    assert len(ends) == COUNT
    data = whole.read_bytes()
    rng = np.random.default_rng(1)
    count = MANY_CUTS if kind in COMMON else CUTS
    cuts = [*rng.integers(0, len(data), count), 0, 1, len(data) - 1]
    cuts += [end + off for end in list(ends.values())[::6] for off in (-1, 0, 1)]
    for cut in sorted(cuts):
        torn = tmp_path / whole.name
        torn.write_bytes(data[:cut])
        before = {stamp for stamp, end in ends.items() if end <= cut}
        given, problems = given_or_nothing(torn)
        assert before <= set(given), f"cut at {cut}"
        assert_messages_are_the_original(given)
        # The last page of a database is one of its index, which is not missed.
        assert problems or len(given) == COUNT, f"cut at {cut}"


def test_a_file_damaged_anywhere_is_read_without_an_unexpected_error(kind, whole, ends, tmp_path):
    data = whole.read_bytes()
    rng = np.random.default_rng(2)
    for i, begin in enumerate(rng.integers(0, len(data), CUTS)):
        size = int(rng.integers(1, 6000))
        fill = (bytes(size), b"\xff" * size, rng.bytes(size))[i % 3]
        damaged = tmp_path / whole.name
        damaged.write_bytes((data[:begin] + fill + data[begin + size :])[: len(data)])
        given, _ = given_or_nothing(damaged)
        before = {stamp for stamp, end in ends.items() if end <= begin}
        if kind == "mcap chunks":  # its checksum is that of four messages
            before = set(sorted(before)[:-MESSAGES_IN_CHUNK])
        if begin > 5 * 4096:  # or the topics of a database are damaged
            assert before <= set(given), f"damaged at {begin}"
        if kind in ("mcap chunks", "mcap lz4", "mcap zstd"):
            assert_messages_are_the_original(given)


# Numbers of bytes that no memory holds, as a length may tell after a flipped bit.
BOMBS = [(1 << 60).to_bytes(8, "little"), b"\xff" * 8, b"\xff\xff\xff\x7f", b"\xff" * 4]
MOST_KB = 50 << 10  # the files here have 0.15 MB


def test_no_length_and_no_flipped_bit_takes_memory_or_time(whole, tmp_path):
    data = whole.read_bytes()
    rng = np.random.default_rng(3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for i in range(CUTS):
        damaged = bytearray(data)
        # Where lengths are: mostly at the begin, and in the index at the end.
        part = (len(data), 9000, 300)[i % 3]
        at = int(rng.integers(0, part))
        at = len(data) - 1 - at if i % 7 == 0 else at
        if i % 2:
            bomb = BOMBS[i // 2 % len(BOMBS)]
            damaged[at : at + len(bomb)] = bomb
        else:
            damaged[at] ^= 1 << int(rng.integers(8))
        file = tmp_path / whole.name
        file.write_bytes(damaged)
        given_or_nothing(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_KB


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_cut_file_that_is_compressed_as_a_whole_gives_what_is_before_the_cut(tmp_path, storage):
    numbers = range(200)  # zstd unpacks by blocks of 128 KB
    file = write_bag(tmp_path / "bag", numbers, storage=storage, compression="file")
    data = file.read_bytes()
    torn = tmp_path / file.name
    counts = []
    for cut in np.linspace(0, len(data), CUTS, dtype=int):
        torn.write_bytes(data[:cut])
        given, problems = given_or_nothing(torn)
        counts.append(len(given))
        assert all(bytes(given[stamp_of(n)]) == cdr_of(n) for n in range(0, len(given), 20))
        assert ("could not be unpacked to its end" in f"{problems}") == (cut < len(data))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert 60 < counts[CUTS // 2] < 140
    assert counts[-1] == 200


def overwrite(file, at, with_):
    data = bytearray(file.read_bytes())
    data[at : at + len(with_)] = with_
    file.write_bytes(data)


def stamps(file):
    given, problems = given_by(file)
    return [list(ORIGINAL).index(stamp) for stamp in given], problems


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_chunks_after_a_damaged_one_are_given(tmp_path, compression):
    file = write_mcap(tmp_path / "bag.mcap", NUMBERS, compression, chunk_size=CHUNK)
    with file.open("rb") as opened:
        chunk = make_reader(opened).get_summary().chunk_indexes[2]
    overwrite(file, chunk.chunk_start_offset + 3000, b"oops")
    given, problems = stamps(file)
    lost = [n for n in NUMBERS if n not in given]
    assert lost == list(range(2 * MESSAGES_IN_CHUNK, 3 * MESSAGES_IN_CHUNK))
    (problem,) = problems
    assert f"the chunk at byte {chunk.chunk_start_offset} is damaged" in problem
    assert f"Whole messages in it: {COUNT - 5}" in problem


def test_where_a_length_is_damaged_reading_goes_on_at_the_next_chunk(tmp_path):
    file = write_mcap(tmp_path / "bag.mcap", NUMBERS, "ZSTD", chunk_size=CHUNK)
    with file.open("rb") as opened:
        chunk = make_reader(opened).get_summary().chunk_indexes[2]
    overwrite(file, chunk.chunk_start_offset, bytes(2000))
    file.write_bytes(file.read_bytes()[:-100])  # and there is no index
    given, problems = stamps(file)
    assert [n for n in NUMBERS if n not in given] == [10, 11, 12, 13, 14]
    assert f"torn at byte {chunk.chunk_start_offset}" in problems[0]


def test_what_the_library_gave_before_it_failed_is_not_given_again(tmp_path):
    # Messages received at the same time could be taken for each other.
    with BagWriter(tmp_path / "bag", compression="chunk") as bag:
        for number in range(8):
            bag.write_image(TOPIC, large(number), stamp_of(number // 3), FRAME_ID)
    file = tmp_path / "bag" / "bag.mcap"
    starts = [found.start() for found in re.finditer(ZSTD, file.read_bytes())]
    # On a busy machine the writer closes chunks by the clock, too, empty ones among them.
    of_images = [a for a, b in pairwise([*starts, file.stat().st_size]) if b - a > 1_000_000]
    overwrite(file, of_images[5], b"oops")
    with open_recording(tmp_path / "bag") as recording:
        for _ in range(2):
            frames = [int(frame.image[0, 0]) for frame in recording]
            assert frames == [0, 1, 2, 3, 4, 6, 7]
            assert recording.skipped == 1
            damage, count = recording.problems
            assert "is damaged" in damage
            assert "tells of 8 images" in count
            assert "only 7 could be read" in count


def large(number):
    """Noise of 1.4 MB, which fills a chunk alone; its first pixel is its number."""
    image = np.random.default_rng(number).integers(0, 65536, (800, 900)).astype(np.uint16)
    image[0, 0] = number
    return image


def test_images_around_damaged_pages_of_a_database_are_given(tmp_path):
    with BagWriter(tmp_path / "bag", storage="sqlite3") as bag:
        for number in range(4):
            bag.write_image(TOPIC, large(number), stamp_of(number), FRAME_ID)
    file = tmp_path / "bag" / "bag.db3"
    page = int(0.6 * file.stat().st_size) // 4096
    overwrite(file, page * 4096, b"\xff" * (3 * 4096))
    with open_recording(tmp_path / "bag") as recording:
        assert [int(frame.image[0, 0]) for frame in recording] == [0, 1, 3]
        assert recording.skipped == 1
        assert "messages that are not whole: 1." in recording.problems[0]


def test_a_database_is_read_whatever_became_of_its_tree(tmp_path):
    file = write_bag(tmp_path / "bag", range(500), storage="sqlite3")
    data = file.read_bytes()
    trees = [at for at in range(4096, len(data), 4096) if data[at] in (0x02, 0x05, 0x0A)]
    assert trees, "no page of an index"
    for at in trees:
        overwrite(file, at, bytes(4096))
    with Bag(file) as bag:
        assert len(list(bag.messages([TOPIC]))) == 500
        assert "is read without its index" in bag.problems[0]


def left_open(path, mode, commits):
    """Copy a database, and what is beside it, while its recorder is at work."""
    whole = write_bag(path / "whole", [], storage="sqlite3")
    database = sqlite3.connect(path / "night.db3")
    with sqlite3.connect(whole) as empty:
        empty.backup(database)
    empty.close()
    database.execute(f"PRAGMA journal_mode = {mode}")
    database.execute("PRAGMA cache_size = 10")  # pages are written before the transaction ends
    database.execute(
        "INSERT INTO topics VALUES (1, ?, ?, 'cdr', '', '')",
        (TOPIC, IMAGE),
    )
    for number in NUMBERS:
        row = (stamp_of(number), cdr_of(number))
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", row)
        if number < commits:
            database.commit()
    (path / "killed").mkdir()
    for file in path.glob("night.db3*"):
        shutil.copy(file, path / "killed")
    database.close()
    return path / "killed"


def test_a_write_ahead_log_beside_a_database_is_read(tmp_path):
    folder = left_open(tmp_path, "WAL", commits=COUNT)
    files = sorted(file.name for file in folder.iterdir())
    assert files == ["night.db3", "night.db3-shm", "night.db3-wal"]
    given, problems = stamps(folder)
    assert given == list(NUMBERS)
    assert "night.db3-wal is beside it: its recorder did not end" in problems[1]
    assert sorted(file.name for file in folder.iterdir()) == files, "nothing is written there"
    log = folder / "night.db3-wal"
    data = log.read_bytes()
    counts = []
    for cut in np.linspace(0, len(data), CUTS, dtype=int):
        log.write_bytes(data[:cut])
        counts.append(len(given_or_nothing(folder)[0]))
    assert counts == sorted(counts)
    assert counts[-1] == COUNT


def test_messages_of_a_transaction_that_did_not_end_are_read(tmp_path):
    folder = left_open(tmp_path, "DELETE", commits=5)
    assert (folder / "night.db3-journal").exists()
    given, problems = stamps(folder)
    assert set(range(5)) < set(given)
    assert len(given) >= COUNT - 8, "those that were still in memory are lost"
    assert "night.db3-journal is beside it" in problems[1]


def test_a_ros1_bag_that_was_being_recorded_is_read(tmp_path):
    whole = write_ros1(tmp_path / "whole.bag", NUMBERS, chunk_bytes=CHUNK)
    with Rosbag1Reader(whole) as reader:
        chunks = sorted(chunk.datapos for chunk in reader.chunks.values())
    data = bytearray(whole.read_bytes())
    # As the recorder leaves it: no index, and the length of the last chunk is still 0.
    index = data.index(b"index_pos=") + len(b"index_pos=")
    data[index : index + 8] = bytes(8)
    data[chunks[5] - 4 : chunks[5]] = bytes(4)
    active = tmp_path / "night.bag.active"
    active.write_bytes(data[: chunks[5] + 9000])
    given, problems = stamps(active)
    assert given == list(range(5 * MESSAGES_IN_CHUNK + 2))
    assert "Bag is not indexed" in problems[0]


def test_an_image_recorded_without_its_topic_is_told(tmp_path):
    file = write_ros1(tmp_path / "old.bag", NUMBERS)
    data = file.read_bytes()
    name = data.index(b"topic=")
    overwrite(file, name, b"tepic=")
    file.write_bytes(file.read_bytes()[:-3000])  # where the topics are told again
    with pytest.raises(RecordingError, match=r"messages whose topic is not in it: \d+"):
        Bag(file)


def test_a_torn_recording_tells_how_many_frames_are_lost(tmp_path):
    file = write_bag(tmp_path / "bag", NUMBERS)
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with open_recording(tmp_path / "bag") as recording:
        assert len(recording) == COUNT
        frames = list(recording)
        assert [frame.stamp_ns for frame in frames] == list(ORIGINAL)[: len(frames)]
        assert len(frames) in (13, 14, 15)
        assert recording.skipped == COUNT - len(frames)
        torn, count = recording.problems
        assert f"of {len(data) // 2} (it ends within a record)" in torn
        assert f"tells of {COUNT} images on {TOPIC}, but only {len(frames)} could" in count


def test_a_file_cut_before_its_first_message_says_where(tmp_path):
    file = write_bag(tmp_path / "bag", NUMBERS)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(RecordingError, match=r"holds no messages: bag.mcap .* torn at byte \d+"):
        Bag(file)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_that_is_emptied_while_it_is_read_is_an_error(tmp_path, storage):
    file = write_bag(tmp_path / "bag", range(500), storage=storage)
    with Bag(file) as bag:
        messages = bag.messages([TOPIC])
        next(messages)
        file.write_bytes(b"")
        with pytest.raises(
            RecordingError, match=r"cannot read .* after \d+ messages: it does not"
        ):
            list(messages)


@pytest.mark.parametrize("kind", ["mcap zstd", "sqlite", "ros1 bz2"], indirect=True)
def test_a_torn_file_that_is_emptied_while_it_is_read_is_an_error(whole, tmp_path):
    torn = tmp_path / whole.name
    torn.write_bytes(whole.read_bytes()[:100_000])
    with Bag(torn) as bag:
        assert bag.problems
        messages = bag.messages([TOPIC])
        next(messages)
        torn.write_bytes(b"")
        with pytest.raises(RecordingError, match=r"after \d+ messages: it has changed while it"):
            list(messages)


def test_a_damaged_head_of_a_message_costs_this_message_only(tmp_path):
    file = write_ros1(tmp_path / "old.bag", NUMBERS)
    times = [found.start() for found in re.finditer(b"time=", file.read_bytes())]
    overwrite(file, times[4], b"tome=")
    file.write_bytes(file.read_bytes()[:-100])
    given, problems = stamps(file)
    assert given == [n for n in NUMBERS if n != 4]
    assert "is damaged: Could not read time field 'time'" in problems[0]
