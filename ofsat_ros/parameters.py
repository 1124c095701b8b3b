"""The one table of parameters: name, default, range, unit, meaning.

Everything else that shows a parameter derives from it: ROS descriptors (``nodes``), the presets'
YAML files, command-line options (``cli``), and the table in the README.  It stands before all
stages and depends on none.

A parameter is a field of one of the frozen dataclasses below.  ``Parameters`` holds what the
pipeline reads; ``DetectorParameters``, ``PlayerParameters``, ``SimulatorParameters`` and
``RecorderParameters`` what only the node of that name reads.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from numbers import Real
from typing import Any, ClassVar, Self

import yaml

DEFAULT_PRESET = "robust"


class ParameterError(ValueError):
    """A parameter's name is unknown, or its value is of the wrong type or out of range."""


@dataclass(frozen=True)
class Description:
    """What the table says about one parameter.

    Attributes
    ----------
    name : str
        Name, the same in ROS, in YAML and on the command line.
    default : bool, int, float or str
        Value when nobody sets it; its type is the parameter's type.
    meaning : str
        One sentence for a user.
    stage : str
        The stage, or node, that reads it.
    unit : str
        Unit, empty for a pure number, a choice or a switch.
    low, high : float or None
        Inclusive range of a number.
    choices : tuple of str
        Allowed values of a choice; empty for the others.
    live : bool
        Whether a running node accepts a new value.
    """

    name: str
    default: Any
    meaning: str
    stage: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = True

    @property
    def allowed(self) -> str:
        """The allowed values in words, for messages and tables."""
        if self.choices:
            return " | ".join(self.choices)
        if isinstance(self.default, bool):
            return "true | false"
        if self.low is not None:
            return f"{self.low:.10g} to {self.high:.10g}"
        return "text"

    def check(self, value: Any) -> Any:
        """Return `value` in the parameter's type.

        Raises
        ------
        ParameterError
            If the value has another type or lies outside the range; the message names the
            parameter, the value and what is allowed.
        """
        kind = type(self.default)
        numeric = isinstance(value, Real) and not isinstance(value, bool)
        if numeric and self.low is not None and self.high is not None:
            if not self.low <= value <= self.high:  # NaN is in no range
                unit = f" {self.unit}" if self.unit else ""
                raise ParameterError(
                    f"{self.name} must be within {self.allowed}{unit}, not {value!r}"
                )
            value = kind(value) if kind(value) == value else value
        if type(value) is not kind:
            words = {bool: "a switch", int: "an integer", float: "a number", str: "text"}
            raise ParameterError(
                f"{self.name} must be {words[kind]} ({self.allowed}), not {value!r}"
            )
        if self.choices and value not in self.choices:
            raise ParameterError(f"{self.name} must be one of {self.allowed}, not {value!r}")
        return value


def _number(
    default: float, low: float, high: float, unit: str, stage: str, meaning: str, live: bool = True
) -> Any:
    about = {"unit": unit, "low": low, "high": high}
    return field(default=default, metadata=dict(stage=stage, meaning=meaning, live=live, **about))


def _choice(choices: str, stage: str, meaning: str, live: bool = True) -> Any:
    """A choice among words separated by spaces; the first is the default."""
    words = tuple(choices.split())
    about = {"choices": words}
    return field(default=words[0], metadata=dict(stage=stage, meaning=meaning, live=live, **about))


def _plain(default: bool | str, stage: str, meaning: str, live: bool = True) -> Any:
    """A switch or a text."""
    return field(default=default, metadata=dict(stage=stage, meaning=meaning, live=live))


@dataclass(frozen=True)
class Table:
    """Base of the parameter classes: checks every value when built."""

    names: ClassVar[str] = "parameter"

    def __post_init__(self) -> None:
        for about in self.describe():
            object.__setattr__(self, about.name, about.check(getattr(self, about.name)))

    @classmethod
    def describe(cls) -> Iterator[Description]:
        """Yield the description of every parameter, in the order of the table."""
        for item in dataclasses.fields(cls):
            yield Description(name=item.name, default=item.default, **item.metadata)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Build from a mapping of names to values; what is absent keeps its default.

        Raises
        ------
        ParameterError
            On an unknown name (the message suggests a similar one) or a bad value.
        """
        return cls().replace(**values)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed.

        Raises
        ------
        ParameterError
            As in `of`.
        """
        known = [item.name for item in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise ParameterError(f"there is no parameter {name!r}{hint}")
        return dataclasses.replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return names and values, in the order of the table."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Parameters(Table):
    """What `Pipeline` reads.  The defaults are those of the preset ``robust``."""

    hot_pixels: str = _choice(
        "replace keep",
        "preprocessing",
        "replace: a pixel brighter than the optics could image a star is a defect, and takes"
        " the median of its neighbours; keep: as published",
    )
    background: str = _choice(
        "mesh none",
        "preprocessing",
        "mesh: subtract a background that varies over the image; none: as published",
    )
    background_cell_px: int = _number(
        64, 8, 1024, "px", "preprocessing", "side of one cell of the background mesh"
    )
    smoothing_sigma_px: float = _number(
        1.0, 0.0, 10.0, "px", "preprocessing", "sigma of the Gaussian smoothing; 0: none"
    )
    threshold_statistics: str = _choice(
        "clipped all",
        "preprocessing",
        "pixels that the mean and std of the threshold are taken of: clipped: without the stars,"
        " and locally with background mesh; all: every pixel, as published",
    )
    threshold_sigmas: float = _number(
        4.0, 0.0, 100.0, "", "preprocessing", "N in: threshold = mean + N std"
    )
    min_area_px: int = _number(
        3, 1, 10000, "px", "objects", "smallest connected region that is an object"
    )
    max_objects: int = _number(
        5000, 10, 100000, "", "objects", "at most this many objects, those of the highest SNR"
    )
    engine: str = _choice(
        "sparse dense",
        "optical_flow",
        "sparse: pyramidal Lucas-Kanade at points; dense: derivative Lucas-Kanade at every pixel",
    )
    flow_targets: str = _choice(
        "objects native",
        "optical_flow",
        "what flow is measured of: objects: each object; native: what the engine itself finds,"
        " corners (sparse) or connected regions of the map of speeds (dense), as published",
    )
    first_guess: str = _choice(
        "field zero",
        "optical_flow",
        "where flow starts: field: at the star field's shift, voted by bright objects; zero: at"
        " no motion, as published",
    )
    stretch: str = _choice(
        "noise range",
        "optical_flow",
        "how the sparse engine's 8 bits are spread: noise: over a span set by the background's"
        " noise; range: over the image's minimum to maximum, as published",
    )
    window_px: int = _number(
        9,
        3,
        101,
        "px",
        "optical_flow",
        "side of the sparse engine's window (made odd); that of a streak is longer by its length",
    )
    pyramid_levels: int = _number(
        3,
        0,
        8,
        "",
        "optical_flow",
        "pyramid levels above the image, sparse engine; objects get them if too few are found"
        " without",
    )
    max_corners: int = _number(
        1000, 1, 100000, "", "optical_flow", "corners kept, sparse engine with native targets"
    )
    corner_quality: float = _number(
        0.01,
        1e-6,
        1.0,
        "",
        "optical_flow",
        "weakest corner kept, as a fraction of the strongest, sparse engine with native targets",
    )
    corner_distance_px: float = _number(
        5.0, 0.0, 100.0, "px", "optical_flow", "least distance between corners, same"
    )
    dense_window_px: int = _number(
        5, 3, 51, "px", "optical_flow", "side of the dense engine's weighted window (made odd)"
    )
    dense_noise_threshold: float = _number(
        4.0,
        0.0,
        1e6,
        "",
        "optical_flow",
        "an eigenvalue of the dense engine's matrix below this many times its value for pure"
        " noise is taken as zero",
    )
    dense_pyramid_levels: int = _number(
        2,
        0,
        8,
        "",
        "optical_flow",
        "pyramid levels above the image, dense engine; 0: as published",
    )
    dense_iterations: int = _number(
        3, 1, 20, "", "optical_flow", "warp-and-solve rounds per level, dense engine; 1: published"
    )
    dense_min_speed_px: float = _number(
        0.1,
        0.0,
        10.0,
        "px",
        "optical_flow",
        "displacement per frame above which a pixel belongs to a region of the map of speeds",
    )
    star_field_model: str = _choice(
        "similarity shift mean",
        "star_field",
        "similarity: robust fit of shift, rotation and scale; shift: of a shift; mean: mean and"
        " std of the velocities with outliers removed, as published",
    )
    outlier_sigmas: float = _number(
        2.0,
        0.5,
        20.0,
        "",
        "star_field",
        "a velocity further than this many std from the mean is left out, model mean",
    )
    rso_test: str = _choice(
        "history vector speed",
        "detection",
        "history: an RSO shines where the last frames show no star, or drifts, along a path that"
        " chance does not explain; vector: its velocity differs from the star field's by more than"
        " its uncertainty, two frames alone; speed: its speed lies outside mean +- k std, as"
        " published",
    )
    rso_sigmas: float = _number(
        6.0,
        0.5,
        100.0,
        "",
        "detection",
        "k of the RSO test, in sigmas of the vector or the speed; tests vector and speed",
    )
    spot_sigmas: float = _number(
        3.0,
        1.0,
        100.0,
        "",
        "detection",
        "least brightness over the star field's of what may be an RSO, in sigmas; test history",
    )
    min_relative_px: float = _number(
        0.3,
        0.0,
        10.0,
        "px",
        "detection",
        "least displacement per frame against the star field, test vector",
    )
    history_frames: int = _number(
        9,
        3,
        100,
        "frames",
        "tracking",
        "frames that are compared, the current one included; more finds slower and fainter RSOs",
    )
    false_tracks: float = _number(
        1e-3,
        1e-12,
        1.0,
        "",
        "tracking",
        "a track is confirmed when chance gives fewer such tracks than this in a frame",
    )
    max_speed_px: float = _number(
        150.0, 1.0, 10000.0, "px", "tracking", "fastest motion against the stars, per frame"
    )
    coast_frames: int = _number(
        5, 0, 1000, "frames", "tracking", "a track unseen in more frames in a row ends"
    )
    max_gap_s: float = _number(
        600.0, 0.001, 1e6, "s", "pipeline", "a longer time between two frames starts afresh"
    )

    @classmethod
    def preset(cls, name: str = DEFAULT_PRESET, **changes: Any) -> Parameters:
        """Return the parameters of a preset, some of them changed.

        Parameters
        ----------
        name : str
            One of `preset_names()`.
        **changes
            Values that differ from the preset's.

        Raises
        ------
        ParameterError
            On an unknown preset, name, or a bad value.
        """
        if name not in preset_names():
            raise ParameterError(
                f"there is no preset {name!r}; there are {', '.join(preset_names())}"
            )
        text = resources.files("ofsat_ros").joinpath(f"presets/{name}.yaml").read_text()
        return cls.of({**yaml.safe_load(text)["/**"]["ros__parameters"], **changes})


def preset_names() -> list[str]:
    """Return the names of the presets shipped with the package, the default first."""
    folder = resources.files("ofsat_ros").joinpath("presets")
    names = sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".yaml"))
    return sorted(names, key=lambda name: name != DEFAULT_PRESET)


@dataclass(frozen=True)
class DetectorParameters(Table):
    """What only the detector node reads."""

    preset: str = _plain(
        DEFAULT_PRESET, "detector", "named set of choices that the others start from", live=False
    )
    image_transport: str = _choice(
        "raw compressed",
        "detector",
        "raw: subscribe to image; compressed: to image/compressed (PNG or JPEG)",
        live=False,
    )
    reliable_input: bool = _plain(
        False,
        "detector",
        "true: reliable subscription, every frame is processed, for replay; false: sensor data,"
        " the newest frame wins once backlog_s is used up, for a live camera",
        live=False,
    )
    queue_depth: int = _number(
        10,
        1,
        1000,
        "frames",
        "detector",
        "depth of the image subscription; more frames wait in memory, up to 1 GiB",
        live=False,
    )
    backlog_s: float = _number(
        0.5,
        0.0,
        60.0,
        "s",
        "detector",
        "live camera: frames may wait so long, and then all but the newest are dropped",
        live=False,
    )
    marker_scale: float = _number(
        5.0, 0.1, 1000.0, "", "detector", "length of a drawn flow vector, in frames of motion"
    )
    no_image_timeout_s: float = _number(
        5.0, 0.1, 3600.0, "s", "detector", "silence on the image topic that is said aloud"
    )


@dataclass(frozen=True)
class PlayerParameters(Table):
    """What the player node reads."""

    bag: str = _plain("", "player", "bag to play: a folder, or an .mcap or .db3 file", live=False)
    topic: str = _plain(
        "", "player", "image topic to play; empty: every image topic in the bag", live=False
    )
    rate: float = _number(
        1.0, 0.0, 1000.0, "", "player", "speed against the recording; 0: as fast as it is taken"
    )
    start_s: float = _number(
        0.0, 0.0, 1e7, "s", "player", "where to start, from the beginning of the bag", live=False
    )
    loop: bool = _plain(False, "player", "start again at the end, until stopped")
    wait_for_subscribers: int = _number(
        1,
        0,
        100,
        "",
        "player",
        "subscribers to each image topic to wait for before the first frame",
        live=False,
    )
    clock: bool = _plain(True, "player", "publish the recording's time on /clock", live=False)


@dataclass(frozen=True)
class SimulatorParameters(Table):
    """What the simulator node reads."""

    scenario: str = _plain("sidereal", "simulator", "scenario to render", live=False)
    seed: int = _number(1, 0, 2**31 - 1, "", "simulator", "seed of the sky and its noise", False)
    rate: float = _number(
        1.0, 0.01, 1000.0, "", "simulator", "speed against the scenario's own clock", live=False
    )
    loop: bool = _plain(
        True, "simulator", "render on beyond the scenario's last frame", live=False
    )


@dataclass(frozen=True)
class RecorderParameters(Table):
    """What the recorder node reads."""

    output: str = _plain(
        "", "recorder", "folder to write; empty: one named by the time", live=False
    )
    overwrite: bool = _plain(
        False, "recorder", "replace what a recorder has left in the folder", live=False
    )
    picture_every: int = _number(
        10, 0, 100000, "frames", "recorder", "keep every n-th annotated picture; 0: none", False
    )
    frames: int = _number(
        0, 0, 2**31 - 1, "", "recorder", "stop after this many frames; 0: until stopped", False
    )


TABLES: tuple[type[Table], ...] = (
    Parameters,
    DetectorParameters,
    PlayerParameters,
    SimulatorParameters,
    RecorderParameters,
)


def markdown_table() -> str:
    """Return the table of all parameters as Markdown, as the README shows it."""
    rows = [
        "| parameter | default | range | unit | read by | meaning |",
        "|---|---|---|---|---|---|",
    ]
    for table in TABLES:
        for p in table.describe():
            default = str(p.default).lower() if isinstance(p.default, bool) else f"{p.default}"
            cells = [f"`{p.name}`", default, p.allowed.replace("|", "\\|"), p.unit, p.stage]
            meaning = p.meaning + ("" if p.live else " (set at start)")
            rows.append("| " + " | ".join([*cells, meaning]) + " |")
    return "\n".join(rows) + "\n"
