# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes, of the camera, and of what is written."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ofsat_ros.parameters.stages import DEFAULT_PRESET
from ofsat_ros.parameters.table import ParameterError, Table, choice, number, plain

# What may stand in a line of a tracking data message, and how much of it.
_LINE_CHARACTERS, _LONGEST_TEXT = re.compile(r"[\x20-\x7e]*"), 200


@dataclass(frozen=True)
class DetectorParameters(Table):
    """What only the detector node reads."""

    preset: str = plain(
        DEFAULT_PRESET, "detector", "named set of choices that the others start from", live=False
    )
    image_transport: str = choice(
        "raw compressed",
        "detector",
        "raw: subscribe to image; compressed: to image/compressed (PNG or JPEG)",
        live=False,
    )
    reliable_input: bool = plain(
        False,
        "detector",
        "true: reliable subscription, every frame is processed, for replay; false: sensor data,"
        " the newest frame wins once backlog_s is used up, for a live camera",
        live=False,
    )
    queue_depth: int = number(
        10,
        1,
        1000,
        "frames",
        "detector",
        "depth of the image subscription; more frames wait in memory, up to 1 GiB",
        live=False,
    )
    backlog_s: float = number(
        0.5,
        0.0,
        60.0,
        "s",
        "detector",
        "live camera: frames may wait so long, and then all but the newest are dropped",
        live=False,
    )
    max_pixels: int = number(
        200_000_000,
        256,
        2**30,
        "px",
        "detector",
        "an image of more is refused before memory is taken for it, also a compressed one whose"
        " header tells of them",
    )
    marker_scale: float = number(
        5.0, 0.1, 1000.0, "", "detector", "length of a drawn flow vector, in frames of motion"
    )
    no_image_timeout_s: float = number(
        5.0, 0.1, 3600.0, "s", "detector", "silence on the image topic that is said aloud"
    )


@dataclass(frozen=True)
class PlayerParameters(Table):
    """What the player node reads."""

    bag: str = plain("", "player", "bag to play: a folder, or an .mcap or .db3 file", live=False)
    topic: str = plain(
        "", "player", "image topic to play; empty: every image topic in the bag", live=False
    )
    rate: float = number(
        1.0, 0.0, 1000.0, "", "player", "speed against the recording; 0: as fast as it is taken"
    )
    start_s: float = number(
        0.0, 0.0, 1e7, "s", "player", "where to start, from the beginning of the bag", live=False
    )
    loop: bool = plain(False, "player", "start again at the end, until stopped")
    wait_for_subscribers: int = number(
        1,
        0,
        100,
        "",
        "player",
        "subscribers to each image topic to wait for before the first frame",
        live=False,
    )
    clock: bool = plain(True, "player", "publish the recording's time on /clock", live=False)


@dataclass(frozen=True)
class SimulatorParameters(Table):
    """What the simulator node reads."""

    scenario: str = plain("sidereal", "simulator", "scenario to render", live=False)
    seed: int = number(1, 0, 2**31 - 1, "", "simulator", "seed of the sky and its noise", False)
    rate: float = number(
        1.0,
        0.01,
        1000.0,
        "",
        "simulator",
        "speed against the scenario's own clock; 1 with a guide, whose clock is the real one",
        live=False,
    )
    loop: bool = plain(True, "simulator", "render on beyond the scenario's last frame", live=False)
    mount_timeout_s: float = number(
        1.0,
        0.01,
        3600.0,
        "s",
        "simulator",
        "a mount stops by itself when the last mount_rate is so old, on the scenario's clock",
        live=False,
    )


@dataclass(frozen=True)
class RecorderParameters(Table):
    """What the recorder node reads."""

    output: str = plain(
        "", "recorder", "folder to write; empty: one named by the time", live=False
    )
    overwrite: bool = plain(
        False, "recorder", "replace what a recorder has left in the folder", live=False
    )
    picture_every: int = number(
        10, 0, 100000, "frames", "recorder", "keep every n-th annotated picture; 0: none", False
    )
    frames: int = number(
        0, 0, 2**31 - 1, "", "recorder", "stop after this many frames; 0: until stopped", False
    )


@dataclass(frozen=True)
class CameraParameters(Table):
    """What turns stamps and pixels into times and directions; detector and ``ofsat process``."""

    exposure_time_s: float = number(
        0.0,
        0.0,
        3600.0,
        "s",
        "camera",
        "length of an exposure; counts if stamps are not its middle",
    )
    stamp_reference: str = choice(
        "middle start end",
        "camera",
        "what an image's stamp tells: middle: of the exposure; start: its begin; end: its end",
    )
    stamp_offset_s: float = number(
        0.0,
        -3600.0,
        3600.0,
        "s",
        "camera",
        "added to an image's stamp: what its clock is behind UTC",
    )
    attitude_max_age_s: float = number(
        1.0,
        0.0,
        600.0,
        "s",
        "camera",
        "an attitude counts for a frame if its stamp is at most this far away; without one, ra and"
        " dec are unknown",
    )


@dataclass(frozen=True)
class GuideParameters(Table):
    """What the guide node reads."""

    target: str = choice(
        "first brightest nearest id",
        "guide",
        "which track is followed: first: the one that was confirmed first; brightest: that of the"
        " greatest flux; nearest: to the boresight; id: that of target_id",
    )
    target_id: int = number(0, 0, 2**31 - 1, "", "guide", "track that is followed with target id")
    engaged: bool = plain(
        False, "guide", "whether it commands the mount from the start; then ~/engage", live=False
    )
    settling_s: float = number(
        1.0,
        0.01,
        600.0,
        "s",
        "guide",
        "time constant in which the offset is brought to zero; at least twice what is unknown of"
        " the latency",
    )
    integral_s: float = number(
        5.0,
        0.0,
        3600.0,
        "s",
        "guide",
        "time in which a standing offset is learned, at least four times settling_s, since it"
        " swings otherwise; 0: never",
    )
    mount_latency_s: float = number(
        0.0,
        0.0,
        10.0,
        "s",
        "guide",
        "from a command to the mount's motion: the offset is predicted",
    )
    max_rate_deg_s: float = number(
        3.0, 1e-6, 360.0, "deg/s", "guide", "fastest rate that is commanded"
    )
    max_acceleration_deg_s2: float = number(
        1.0, 1e-6, 1000.0, "deg/s^2", "guide", "fastest change of the commanded rate"
    )
    stale_after_s: float = number(
        2.0,
        0.01,
        60.0,
        "s",
        "guide",
        "if the target was not seen for so long, the commanded rate decays to zero; until then it"
        " goes on as last known",
    )
    decay_s: float = number(
        0.5,
        0.0,
        60.0,
        "s",
        "guide",
        "time in which the commanded rate then decays to zero; longer if the acceleration's limit"
        " asks for it",
    )
    reacquire_s: float = number(
        10.0,
        0.0,
        3600.0,
        "s",
        "guide",
        "for so long after a loss, a new track on the lost one's path is the same object",
    )
    command_hz: float = number(
        20.0, 0.1, 1000.0, "Hz", "guide", "how often the mount is commanded", live=False
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        least_s = 4 * self.settling_s
        if 0 < self.integral_s < least_s * (1 - 1e-9):
            raise ParameterError(
                f"integral_s = {self.integral_s:g} s must be at least four times settling_s ="
                f" {self.settling_s:g} s, so at least {least_s:g} s, or 0"
            )


@dataclass(frozen=True)
class TrackingDataParameters(Table):
    """What the tdm_writer node and ``ofsat process --tdm`` say in their files."""

    station: str = plain(
        "OFSAT",
        "tracking_data",
        "name of the station: PARTICIPANT_1; for format iod its four digits",
    )
    originator: str = plain("OFSAT_ROS", "tracking_data", "who makes the message: ORIGINATOR")
    object_names: str = plain(
        "",
        "tracking_data",
        "names of tracks that are known, as 3=25544,7=GEO-1; others are UNKNOWN-3",
    )
    zero_point_mag: float = number(
        0.0,
        -50.0,
        50.0,
        "mag",
        "tracking_data",
        "magnitude of one DN per exposure; 0: unknown, and no magnitudes are written",
    )
    time_sigma_s: float = number(
        0.01,
        0.0,
        3600.0,
        "s",
        "tracking_data",
        "std of the images' times against UTC, which the camera's clock and driver have; that of a"
        " PC with NTP is some 0.01; 0: unknown",
    )
    least_detections: int = number(
        3, 1, 100000, "", "tracking_data", "a track of fewer directions is not written"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("station", "originator"):
            _check_text(name, getattr(self, name))
        _ = self.object_by_track

    @property
    def object_by_track(self) -> dict[str, str]:
        """Names of known tracks by what stands in their ``UNKNOWN-``: ``3``, or ``3-2``."""
        names: dict[str, str] = {}
        for entry in filter(None, map(str.strip, self.object_names.split(","))):
            track, _, name = (part.strip() for part in entry.partition("="))
            if not re.fullmatch(r"[1-9]\d*(-[1-9]\d*)?", track) or not name or track in names:
                raise ParameterError(
                    "object_names must be numbers of tracks with a name each, written as"
                    f" 3=25544,7=GEO-1, not {self.object_names!r}: see {entry!r}"
                )
            _check_text("object_names", name)
            names[track] = name
        return names


@dataclass(frozen=True)
class TdmWriterParameters(Table):
    """What only the tdm_writer node reads."""

    output: str = plain(
        "", "tdm_writer", "folder to write; empty: one named by the time", live=False
    )
    format: str = choice(
        "kvn xml iod",
        "tdm_writer",
        "kvn: CCSDS TDM, text; xml: CCSDS TDM, XML; iod: as on SeeSat-L",
        live=False,
    )
    ended_after_s: float = number(
        10.0,
        0.1,
        3600.0,
        "s",
        "tdm_writer",
        "a track that is not heard of for so long, in the time of the stamps, has ended, and is"
        " written",
    )
    longest_directions: int = number(
        500,
        10,
        100000,
        "frames",
        "tdm_writer",
        "so many directions of a track make a file, and those that follow the next: the node ends"
        " as soon as the open ones are written",
    )


def _check_text(name: str, text: str) -> None:
    """Refuse what cannot stand in a tracking data message."""
    if not text.strip() or len(text) > _LONGEST_TEXT or not _LINE_CHARACTERS.fullmatch(text):
        raise ParameterError(
            f"{name} must be 1 to {_LONGEST_TEXT} printable ASCII characters in one line, as"
            f" tracking data messages want it, not {text!r}"
        )
