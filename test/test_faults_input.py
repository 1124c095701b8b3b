# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""A camera that sends nonsense: each kind of it is named once, none is believed, none ends a node.

Nonsense comes amid good frames of one satellite: it must be found again in the next ones, and
nothing else with it.
"""

import math
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from ros_graph import Graph, Process, header, image, padded_big_endian, sky, stamps
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from ofsat_ros.camera import Astrometry, Camera, CameraError
from ofsat_ros.detection import DETECTION_DTYPE
from ofsat_ros.images import EncodingError, decode_message, encode_png
from ofsat_ros.nodes import causes, messages
from ofsat_ros.nodes.causes import Causes
from ofsat_ros.nodes.detector import Detector
from ofsat_ros.parameters import (
    TABLES,
    CameraParameters,
    DetectorParameters,
    ParameterError,
    Parameters,
)
from ofsat_ros.pipeline import ImageError, Pipeline
from ofsat_ros.preprocessing import blank_words
from ofsat_ros.simulation import SimulatedFrame, scenario

RELIABLE = ("-p", "reliable_input:=true")
MONO = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32FC1": "f4"}
COLOUR = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
BAYER = [f"bayer_{name}{bits}" for name in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)]
ENCODINGS = [*MONO, *COLOUR, *BAYER]
NO_SENDER = {"publication_sequence_number": None}
# Frames of the scene, and which of them are replaced.
FRAMES, BAD = 12, (5, 6)
FUZZ = {
    "deadline": None,
    "derandomize": True,
    "database": None,
    "suppress_health_check": list(HealthCheck),
}


@pytest.fixture(scope="module")
def scene():
    return sky(FRAMES)


def crossing(frames: int) -> list[SimulatedFrame]:
    """Frames through all of which the RSO of `sky` is in the image."""
    about = {"width": 256, "height": 192, "period_s": 0.5, "exposure_s": 0.5, "star_count": 60}
    return list(scenario("sidereal", 3, frames=frames, **about))


def encoded(frame, encoding: str, bigendian: bool = False) -> Image:
    """Return a frame as a camera of that encoding sends it."""
    bits = 8 if encoding.endswith(("8", "8UC1")) else 16
    dtype = MONO.get(encoding, f"u{bits // 8}")
    # Noise of some 500 DN and a satellite of 5000 over a background of 3000.
    pixels = np.minimum(frame.image // 64, 255) if bits == 8 else frame.image
    pixels = np.dstack([pixels] * COLOUR[encoding]) if encoding in COLOUR else pixels
    data = pixels.astype(np.dtype(dtype).newbyteorder(">" if bigendian else "<"))
    height, width = frame.image.shape
    return Image(
        header=header(frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(bigendian),
        step=data[0].nbytes,
        data=data.tobytes(),
    )


def floats(frame, change) -> Image:
    message = encoded(frame, "32FC1")
    with np.errstate(all="ignore"):
        message.data = change(frame.image.astype(np.float32)).astype("<f4").tobytes()
    return message


def changed(frame, **fields) -> Image:
    message = image(frame)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def filled(frame, value: int) -> Image:
    return messages.image_message(header(frame), np.full_like(frame.image, value))


def cropped(frame, rows: int, columns: int) -> Image:
    return messages.image_message(header(frame), frame.image[:rows, :columns])


def patched(pixels: np.ndarray, value: float) -> np.ndarray:
    pixels = pixels.copy()
    pixels[50:90:3, 60:200:5] = value
    return pixels


def far_tracks(tracks: np.ndarray, frame) -> int:
    """Return how many tracks are not where the one RSO is.

    A track that coasts drifts from it by some 0.1 px a frame.
    """
    truth = frame.truth[0]
    away = np.hypot(tracks["x"] - truth["x_px"], tracks["y"] - truth["y_px"])
    return int(np.count_nonzero(away > 3))


@pytest.mark.parametrize(
    ("encoding", "bigendian"),
    [*((name, False) for name in ENCODINGS), *((name, True) for name in MONO if "8" not in name)],
)
def test_the_rso_is_found_in_every_encoding(scene, encoding, bigendian):
    pipeline = Pipeline()
    for frame in scene[:8]:
        pixels = decode_message(encoded(frame, encoding, bigendian))
        result = pipeline.process(pixels, frame.stamp_ns)
        assert not far_tracks(result.tracks, frame)
    assert len(result.tracks) == 1


CHANGES = {
    "mono16 to mono8": lambda f: encoded(f, "mono8"),
    "mono to colour": lambda f: encoded(f, "rgb8"),
    "mono to Bayer": lambda f: encoded(f, "bayer_rggb16"),
    "big-endian and padded": padded_big_endian,
    "big-endian that says it is little": lambda f: changed(f, is_bigendian=1),
    "16 bits of 12": lambda f: messages.image_message(header(f), f.image * np.uint16(4)),
    "another resolution": lambda f: cropped(f, 150, 200),
    "float": lambda f: encoded(f, "32FC1"),
    "all black": lambda f: filled(f, 0),
    "all saturated": lambda f: filled(f, 65535),
    "NaN in places": lambda f: floats(f, lambda p: patched(p, np.nan)),
    "inf in places": lambda f: floats(f, lambda p: patched(p, -np.inf)),
    "huge in places": lambda f: floats(f, lambda p: patched(p, 3e38)),
    "denormal": lambda f: floats(f, lambda p: p * np.float32(1e-44)),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_camera_that_changes_for_two_frames_costs_only_these_and_what_makes_a_track(
    scene, change
):
    pipeline = Pipeline()
    settled = []
    for number, frame in enumerate(scene):
        message = change(frame) if number in BAD else image(frame)
        result = pipeline.process(decode_message(message), frame.stamp_ns)
        settled += result.settled
        assert not far_tracks(result.tracks, frame)
        assert len(result.tracks) == 1 or not 3 <= number < BAD[0]
    assert len(result.tracks) == 1
    for word in settled + pipeline.finish():
        rows = word.detections[word.detections["track_id"] > 0]
        assert not far_tracks(rows, scene[word.frame])


UNUSABLE = {
    "unknown encoding": (lambda f: changed(f, encoding="yuv422"), "unknown encoding 'yuv422'"),
    "endless encoding": (
        lambda f: changed(f, encoding="\x1b[2J" * 99999),
        r"\x1b[2J\x1b[2J...'; known are mono8",
    ),
    "step too small": (lambda f: changed(f, step=511), "step of 511 bytes is too small: 256 px"),
    "step too large": (lambda f: changed(f, step=2**32 - 1), "with a step of 4294967295 bytes"),
    "height too large": (lambda f: changed(f, height=193), "98304 bytes, but 193 rows"),
    "no width": (lambda f: changed(f, width=0), "no pixels: width 0, height 192"),
    "no data": (lambda f: changed(f, data=b""), "image data is empty: 0 bytes"),
    "cut": (lambda f: changed(f, data=image(f).data[:-1]), "too short: 98303 bytes"),
    "absurd size": (
        lambda f: changed(f, width=2**32 - 1, height=2**32 - 1, step=2**32 - 1),
        "too many pixels: 4294967295 x 4294967295, where max_pixels allows 200000000",
    ),
    "tiny": (lambda f: cropped(f, 15, 200), "an image of shape (15, 200) cannot be processed"),
    "all NaN": (lambda f: floats(f, lambda p: p * np.nan), "image is a finite number"),
    "huge": (lambda f: floats(f, lambda p: p * np.float32(1e31)), "is below 1e15, as DN are"),
    "endless frame_id": (
        lambda f: changed(f, header=header(f, "x" * 100_000)),
        "header.frame_id has 100000 characters, more than 255",
    ),
    "black": (lambda f: filled(f, 0), "the image is empty: all of its pixels are 0; see to shut"),
    "saturated": (lambda f: filled(f, 65535), "saturated: most of its pixels are 65535"),
}


class Night:
    """A detector, a camera before it, and all that it says: its answers, states and log."""

    def __init__(self, graph: Graph, kind: type = Image, topic: str = "image") -> None:
        self.graph = graph
        self._log = graph.listen(Log, "/rosout")
        self._states = graph.listen(DiagnosticArray, "/diagnostics")
        self.tracks = graph.listen(PointCloud2, "rso_tracks")
        self.detections = graph.listen(PointCloud2, "rso_detections")
        self.detector = graph.add(Detector(graph.context))
        self.camera = graph.publisher(kind, topic)
        outputs = ("/rso_tracks", "/rso_detections", "/rosout", "/diagnostics")
        graph.connect(self.camera, *(p for p in self.publishers if p.topic_name in outputs))

    @property
    def publishers(self) -> list:
        return list(self.detector.publishers)

    def send(self, message, stamp_ns: int = 0) -> np.ndarray:
        """Send an image and return the tracks of its answer."""
        if stamp_ns:
            message.header.stamp = messages.time_message(stamp_ns)
        wanted = len(self.tracks) + 1
        self._states.clear()
        self.camera.publish(message)
        self.graph.until(lambda: len(self.tracks) == len(self.detections) == wanted)
        assert stamps(self.tracks)[-1] == messages.stamp_ns(message.header.stamp)
        return messages.tracks_array(self.tracks[-1])

    def state(self, words: str = "", level: bytes = DiagnosticStatus.OK) -> None:
        """Wait for a state, after the last image was sent, of a level and with some words."""
        self.graph.until(
            lambda: any(
                s.level == level and words in s.message for a in self._states for s in a.status
            )
        )

    def said(self, words: str) -> int:
        """Return how many lines of the log contain some words."""
        return sum(words in line.msg for line in self._log)


def test_what_shows_nothing_is_said_once_and_the_rso_is_there_in_the_next_good_frame(monkeypatch):
    monkeypatch.setattr(causes, "_AGAIN_AFTER_S", 0.0)
    frames = iter(crossing(4 + len(UNUSABLE)))
    with Graph(*RELIABLE) as graph:
        night = Night(graph)
        for frame in (next(frames) for _ in range(4)):
            tracks = night.send(image(frame))
        for name, (make, words) in UNUSABLE.items():
            for late_ns in (1, 2):
                # Between two good frames, as of a camera that sends more than it exposes.
                seen = night.send(make(frame), frame.stamp_ns + 200_000_000 * late_ns)
                assert len(seen) <= 1, name  # through a blank frame it coasts
                night.state(words, DiagnosticStatus.WARN)
            frame = next(frames)
            tracks = night.send(image(frame))
            assert len(tracks) == 1, name
            assert not far_tracks(tracks, frame), name
            night.state()
        graph.until(lambda: night.said("found again, after 2 frames") == len(UNUSABLE))
        for name, (_, words) in UNUSABLE.items():
            assert night.said(words) == 1, name
    assert set(tracks["track_id"]) == {1}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(width: int, height: int) -> bytes:
    """Return a black PNG, 8 bit, as small as it can be."""
    about = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes((width + 1) * height), 9)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", about) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )


def flipped(png: bytes, at: int) -> bytes:
    return png[:at] + bytes([png[at] ^ 8]) + png[at + 1 :]


def jpeg(frame) -> bytes:
    return cv2.imencode(".jpg", (frame.image >> 8).astype(np.uint8))[1].tobytes()


COMPRESSED = {
    "no picture": (lambda f: b"GIF89a123", "neither PNG nor JPEG: its 9 bytes begin with 47 49"),
    "nothing": (lambda f: b"", "image data is empty: 0 bytes"),
    "cut PNG": (lambda f: encode_png(f.image)[:-5], "is cut short: its chunk at byte"),
    "flipped bit": (lambda f: flipped(encode_png(f.image), 9000), "does not have its checksum"),
    "flipped height": (lambda f: flipped(encode_png(f.image), 22), "does not have its checksum"),
    "cut JPEG": (lambda f: jpeg(f)[:-9], "cut short: it has no end marker"),
    "bomb": (
        lambda f: bomb(1000, 700),
        "too many pixels: 1000 x 700, where max_pixels allows 600000",
    ),
}


def test_damaged_compressed_images_are_named_and_the_next_ones_used(capfd):
    frames = iter(crossing(4 + len(COMPRESSED)))
    arguments = (*RELIABLE, "-p", "image_transport:=compressed", "-p", "max_pixels:=600000")
    with Graph(*arguments) as graph:
        night = Night(graph, CompressedImage, "image/compressed")

        def send(frame, data: bytes, late_ns: int = 0) -> np.ndarray:
            message = CompressedImage(header=header(frame), format="png", data=data)
            return night.send(message, frame.stamp_ns + late_ns)

        for frame in (next(frames) for _ in range(4)):
            send(frame, encode_png(frame.image))
        for name, (make, words) in COMPRESSED.items():
            send(frame, make(frame), 200_000_000)
            night.state(words, DiagnosticStatus.WARN)
            frame = next(frames)
            tracks = send(frame, encode_png(frame.image))
            assert len(tracks) == 1, name
            assert not far_tracks(tracks, frame), name
    # Nor do the decoders print for themselves what the log does not bound.
    assert "libpng" not in capfd.readouterr().err


def test_max_pixels_changes_live(scene):
    with Graph(*RELIABLE) as graph:
        night = Night(graph)
        night.detector.set_parameters([Parameter("max_pixels", value=1000)])
        night.send(image(scene[0]))
        night.state("256 x 192, where max_pixels allows 1000", DiagnosticStatus.WARN)
        night.detector.set_parameters([Parameter("max_pixels", value=256 * 192)])
        night.send(image(scene[1]))
        night.state("first frame")


def test_an_error_inside_a_stage_is_told_once_with_its_place_and_the_next_frames_are_used(
    scene, monkeypatch
):
    with Graph(*RELIABLE) as graph:
        night = Night(graph)
        pipeline = night.detector._pipeline
        process, broken = pipeline.process, list(range(3))

        def failing(*arguments):
            if broken:
                raise ZeroDivisionError(f"number {broken.pop()}")
            return process(*arguments)

        monkeypatch.setattr(pipeline, "process", failing)
        for frame in scene:
            tracks = night.send(image(frame))
        graph.until(lambda: night.said("after 3 frames without"))
        assert night.said("ZeroDivisionError") == night.said("in failing") == 1
    assert len(tracks) == 1


def test_causes_are_told_once_and_again_when_they_come_back(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(causes, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    told = Causes()
    assert told.right() == 0
    assert told.wrong("too short: 17 bytes")
    # Another number is no other cause.
    assert [told.wrong(f"too short: {n} bytes") for n in range(5)] == [False] * 5
    assert told.wrong("unknown encoding 'a'")
    assert told.right() == 7
    assert told.right() == 0
    now_s[0] += 59.0
    assert not told.wrong("too short: 3 bytes")
    # Its begin was not told, so its end isn't either.
    assert told.right() == 0
    now_s[0] += 2.0
    assert told.wrong("too short: 3 bytes")
    assert told.right() == 1
    # Two that take turns, thirty times a second, for ten minutes.
    lines = 0
    for number in range(30 * 600):
        now_s[0] += 1 / 30
        lines += told.wrong("one" if number % 2 else "two")
    assert 2 * 9 <= lines <= 2 * 11


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.zeros((9, 9), np.uint16), "all of its pixels are 0; see to shutter"),
        (np.full((9, 9), 100, np.uint8), "all of its pixels are 100;"),
        (np.full((9, 9), 255, np.uint8), "saturated: most of its pixels are 255"),
        # 12 bits in 16.
        (np.full((9, 9), 4095, np.uint16), "saturated: most of its pixels are 4095"),
        (np.full((9, 9), 1.5, np.float32), "all of its pixels are 1.5;"),
        (np.where(np.eye(9) > 0, np.nan, 2.0).astype(np.float32), "all of its pixels are 2;"),
        # A dark sky after compression, and one bright object in it.
        (np.eye(9, dtype=np.uint8), ""),
        (np.where(np.eye(9) > 0, 9, 10).astype(np.uint8), ""),
        (np.eye(9, dtype=np.uint16) * 65535, ""),
    ],
)
def test_blank_images_are_told_from_dark_ones(pixels, words):
    said = blank_words(pixels)
    assert words in said
    assert bool(said) == bool(words)


# Fuzz: whatever comes, there is an answer in words, and the next good frame is as good as ever.

WORDS = st.integers(0, 70) | st.sampled_from([2**31, 2**32 - 1])
SMALL = sky(6, width=40, height=32, star_count=8)


@st.composite
def any_image(draw) -> SimpleNamespace:
    """A message of a small image: sound, but for what is drawn anew."""
    encoding = draw(st.sampled_from(ENCODINGS))
    channels = COLOUR.get(encoding, 1)
    size = 4 if encoding == "32FC1" else 2 if encoding.endswith(("16", "16UC1")) else 1
    width, height = draw(st.integers(14, 40)), draw(st.integers(14, 32))
    step = width * channels * size + draw(st.sampled_from([0, 0, 1, 7]))
    seed, length = draw(st.integers(0, 9)), step * height
    kind = draw(st.sampled_from(["noise", "dim noise", "full", "none"]))
    data = {
        "noise": np.random.default_rng(seed).bytes(length),
        "dim noise": (np.frombuffer(np.random.default_rng(seed).bytes(length), "u1") >> 4),
        "full": b"\xff" * length,
        "none": bytes(length),
    }[kind]
    fields = {"encoding": encoding, "width": width, "height": height, "step": step}
    fields |= {"is_bigendian": draw(st.integers(0, 255)), "data": bytes(data)}
    for name in draw(st.sets(st.sampled_from(["encoding", "width", "height", "step", "data"]))):
        other = {"encoding": st.text(max_size=8), "data": st.binary(max_size=99)}.get(name, WORDS)
        fields[name] = draw(other)
    return SimpleNamespace(**fields)


@st.composite
def any_compressed(draw) -> SimpleNamespace:
    """A PNG or JPEG with some bytes replaced, added or missing."""
    frame = SMALL[draw(st.integers(0, 5))]
    data = bytearray(draw(st.sampled_from([encode_png(frame.image), jpeg(frame), bomb(30, 20)])))
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, 40) | st.integers(0, len(data)))
        data[at : at + draw(st.integers(0, 9))] = draw(st.binary(max_size=9))
    form = draw(st.sampled_from(["png", "bayer_rggb16; png compressed", "rgb8; jpeg compressed"]))
    return SimpleNamespace(data=bytes(data), format=form)


@pytest.fixture(scope="module")
def running() -> Pipeline:
    """A pipeline that has seen some frames, and whatever the cases before brought it."""
    pipeline = Pipeline()
    for frame in SMALL:
        pipeline.process(frame.image, frame.stamp_ns)
    return pipeline


@settings(max_examples=2000, **FUZZ)
@given(message=any_image() | any_compressed(), late_ns=st.integers(-(10**10), 10**10))
def test_any_message_is_processed_or_refused_in_words(running, message, late_ns):
    try:
        pixels = decode_message(message)
        result = running.process(pixels, SMALL[-1].stamp_ns + late_ns)
    except (EncodingError, ImageError) as error:
        why = str(error)
    else:
        why = ""
    assert not why or (20 < len(why) < 600 and why.isprintable())
    if why:
        return
    assert result.shape == pixels.shape
    assert bool(result.reason) == (len(result.detections) == 0)
    for rows in (result.detections, result.tracks):
        assert np.isfinite(rows["x"]).all()
        assert np.isfinite(rows["vx"]).all()


def test_hundreds_of_messages_leave_a_node_as_good_as_new():
    heard = 0
    with Graph(*RELIABLE) as graph:
        night = Night(graph)

        @settings(max_examples=250, **FUZZ)
        @given(
            message=any_image(),
            frame_id=st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=300),
            sec=st.integers(-(2**31), 2**31 - 1),
            nanosec=st.integers(0, 2**32 - 1),
        )
        def take(message, frame_id, sec, nanosec):
            nonlocal heard
            one = Image(**vars(message))
            one.header.frame_id = frame_id
            one.header.stamp.sec, one.header.stamp.nanosec = sec, nanosec
            night.detector._on_image(one, NO_SENDER)
            heard += 1
            if heard % 20 == 0:
                graph.until(lambda: len(night.detections) == len(night.tracks) == heard)

        take()
        graph.until(lambda: len(night.detections) == len(night.tracks) == heard)
        for frame in sky(10):
            tracks = night.send(image(frame))
    assert heard >= 250
    assert len(tracks) == 1
    assert not far_tracks(tracks, frame)


VALUES = st.one_of(
    st.floats(),
    st.integers(),
    st.booleans(),
    st.text(max_size=20),
    st.none(),
    st.lists(st.floats(), max_size=3),
    st.sampled_from(["dense", "keep", "mean", "native", "range", "vector", "zero", 0, 1.0, 3]),
)
LIVE = [about for about in Parameters.describe() if about.live]


@settings(max_examples=400, **FUZZ)
@given(data=st.data(), table=st.sampled_from(TABLES))
def test_any_value_is_refused_by_name_or_in_range(data, table):
    about = data.draw(st.sampled_from(list(table.describe())))
    value = data.draw(VALUES)
    try:
        changed = table().replace(**{about.name: value})
    except ParameterError as error:
        why = str(error)
    else:
        why = ""
    assert not why or about.name in why
    if why:
        return
    assert type(getattr(changed, about.name)) is type(about.default)
    if about.low is not None:
        assert about.low <= getattr(changed, about.name) <= about.high


def within(about) -> st.SearchStrategy:
    """Values that a parameter allows, its ends among them."""
    if about.choices:
        return st.sampled_from(about.choices)
    if isinstance(about.default, int):
        return st.integers(int(about.low), int(about.high)) | st.integers(
            int(about.low), int(min(about.high, about.low + 20))
        )
    return st.floats(about.low, about.high) | st.sampled_from([about.low, about.high])


@settings(max_examples=20, **FUZZ)
@given(data=st.data())
def test_any_parameters_together_process_any_frames(data):
    names = data.draw(st.sets(st.sampled_from(range(len(LIVE))), min_size=1))
    changes = {LIVE[n].name: data.draw(within(LIVE[n]), LIVE[n].name) for n in sorted(names)}
    pipeline = Pipeline()
    for number, frame in enumerate(SMALL):
        if number == data.draw(st.integers(0, 4)):
            pipeline.parameters = pipeline.parameters.replace(**changes)
        result = pipeline.process(frame.image, frame.stamp_ns)
        assert bool(result.reason) == (len(result.detections) == 0)
    pipeline.finish()


def test_parameters_set_live_at_random_leave_a_node_that_answers(scene):
    names = [
        p.name for t in (Parameters, CameraParameters, DetectorParameters) for p in t.describe()
    ]
    with Graph(*RELIABLE) as graph:
        night = Night(graph)
        accepted = []

        @settings(max_examples=150, **FUZZ)
        @given(
            changes=st.dictionaries(
                st.sampled_from([*names, "use_sim_time"]), VALUES, min_size=1, max_size=4
            )
        )
        def change(changes):
            parameters = [Parameter(name, value=value) for name, value in changes.items()]
            result = night.detector.set_parameters_atomically(parameters)
            accepted.append(result.successful)
            assert result.successful or result.reason

        change()
        assert set(accepted) == {True, False}
        night.send(image(scene[0]))
        assert all(night.detector.has_parameter(name) for name in names)


BAD_STARTS = {
    "switch: 5": "use_sim_time: 5",
    "QoS": "qos_overrides./image.subscription.depth: deep",
}


def test_bad_parameter_files_are_one_line_and_exit_code_2(tmp_path):
    started = {}
    for name, line in BAD_STARTS.items():
        folder = tmp_path / str(len(started))
        folder.mkdir()
        (folder / "bad.yaml").write_text(f"/**:\n  ros__parameters:\n    {line}\n")
        arguments = ("--ros-args", "--params-file", str(folder / "bad.yaml"))
        started[name] = Process(folder, "detector", *arguments)
    for name, process in started.items():
        with process:
            assert process.wait(60.0) == 2, name
            assert len(process.err.splitlines()) == 1, process.err
            assert process.err.startswith("detector: ")
            assert BAD_STARTS[name].partition(":")[0] in process.err


@settings(max_examples=100, **FUZZ)
@given(data=st.data())
def test_any_calibration_is_used_or_refused_in_words(data):
    draw = data.draw
    k = [4e4, 0.0, 80.0, 0.0, 4e4, 60.0, 0.0, 0.0, 1.0]
    for place in draw(st.sets(st.integers(0, 8), max_size=3)):
        k[place] = draw(st.floats())
    sizes = st.sampled_from([160, 160, 160, 0, 1, 2**31, 2**32 - 1])
    zero = st.sampled_from([0, 0, 0, 1, 2, 2**32 - 1])
    message = SimpleNamespace(
        k=np.array(k),
        d=draw(st.lists(st.floats() | st.floats(-0.5, 0.5), max_size=14)),
        distortion_model=draw(
            st.sampled_from(["plumb_bob", "", "rational_polynomial", "fisheye", "new"])
        ),
        width=draw(sizes),
        height=draw(sizes),
        binning_x=draw(zero),
        binning_y=draw(zero),
        roi=SimpleNamespace(
            x_offset=draw(zero), y_offset=draw(zero), width=draw(zero), height=draw(zero)
        ),
    )
    rows = np.zeros(3, DETECTION_DTYPE)
    rows["x"], rows["y"] = [0.0, 80.0, np.nan], [0.0, 60.0, 1e4]
    astrometry = Astrometry(CameraParameters())
    try:
        astrometry.camera = Camera.from_message(message)
    except CameraError:
        return
    assert "no attitude" in astrometry.locate(rows, 0)
    # Lengths are 1, or unknown.
    lengths = np.linalg.norm(rows["sight"], axis=1)
    assert (np.isnan(lengths) | (np.abs(lengths - 1) < 1e-6)).all()


def test_a_calibration_that_turns_to_nonsense_costs_directions_and_no_detection(scene):
    good = CameraInfo(width=256, height=192, k=[4e4, 0, 128, 0, 4e4, 96, 0, 0, 1])
    bad = CameraInfo(width=256, height=192, k=[math.nan] * 9)
    nowhere = QuaternionStamped()
    nowhere.quaternion.w = math.nan
    with Graph(*RELIABLE) as graph:
        night = Night(graph)
        info = graph.publisher(CameraInfo, "camera_info")
        attitude = graph.publisher(QuaternionStamped, "attitude")
        graph.connect(info, attitude)
        # Topics have no order among them: a frame is sent until the calibration was heard.
        sent = iter(crossing(24))

        def calibrate(message: CameraInfo, known: bool) -> None:
            for frame in sent:
                for _ in range(3):
                    info.publish(message)
                    attitude.publish(nowhere)
                graph.serve(0.05)
                tracks = night.send(image(frame))
                if len(tracks) and np.isfinite(tracks["sight"]).all() == known:
                    return
            raise AssertionError("never heard")

        calibrate(good, known=True)
        night.state()
        calibrate(bad, known=False)
        night.state(
            "camera_info: the calibration contains values that are not numbers",
            DiagnosticStatus.WARN,
        )
        calibrate(good, known=True)
        night.state()
        graph.until(lambda: night.said("are not numbers; directions are unknown"))
        assert night.said("are not numbers; directions are unknown") == 1
        assert night.said("an attitude is left out: a quaternion of length nan") == 1
