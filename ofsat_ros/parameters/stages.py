# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The parameters of the pipeline's stages, and their presets."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from typing import Any

import yaml

from ofsat_ros.parameters.table import ParameterError, Table, choice, number

DEFAULT_PRESET = "robust"


@dataclass(frozen=True)
class Parameters(Table):
    """What `Pipeline` reads.  The defaults are those of the preset ``robust``."""

    hot_pixels: str = choice(
        "replace keep",
        "preprocessing",
        "replace: a pixel brighter than the optics could image a star is a defect, and takes"
        " the median of its neighbours; keep: as published",
    )
    background: str = choice(
        "mesh none",
        "preprocessing",
        "mesh: subtract a background that varies over the image; none: as published",
    )
    background_cell_px: int = number(
        64, 8, 1024, "px", "preprocessing", "side of one cell of the background mesh"
    )
    smoothing_sigma_px: float = number(
        1.0, 0.0, 10.0, "px", "preprocessing", "sigma of the Gaussian smoothing; 0: none"
    )
    threshold_statistics: str = choice(
        "clipped all",
        "preprocessing",
        "pixels that the mean and std of the threshold are taken of: clipped: without the stars,"
        " and locally with background mesh; all: every pixel, as published",
    )
    threshold_sigmas: float = number(
        4.0, 0.0, 100.0, "", "preprocessing", "N in: threshold = mean + N std"
    )
    min_area_px: int = number(
        3, 1, 10000, "px", "objects", "smallest connected region that is an object"
    )
    max_objects: int = number(
        5000, 10, 100000, "", "objects", "at most this many objects, those of the highest SNR"
    )
    engine: str = choice(
        "sparse dense",
        "optical_flow",
        "sparse: pyramidal Lucas-Kanade at points; dense: derivative Lucas-Kanade at every pixel",
    )
    flow_targets: str = choice(
        "objects native",
        "optical_flow",
        "what flow is measured of: objects: each object; native: what the engine itself finds,"
        " corners (sparse) or connected regions of the map of speeds (dense), as published",
    )
    first_guess: str = choice(
        "field zero",
        "optical_flow",
        "where flow starts: field: at the star field's shift, voted by bright objects; zero: at"
        " no motion, as published",
    )
    stretch: str = choice(
        "noise range",
        "optical_flow",
        "how the sparse engine's 8 bits are spread: noise: over a span set by the background's"
        " noise; range: over the image's minimum to maximum, as published",
    )
    window_px: int = number(
        9,
        3,
        101,
        "px",
        "optical_flow",
        "side of the sparse engine's window (made odd); that of a streak is longer by its length",
    )
    pyramid_levels: int = number(
        3,
        0,
        8,
        "",
        "optical_flow",
        "pyramid levels above the image, sparse engine; objects get them if too few are found"
        " without",
    )
    max_corners: int = number(
        1000, 1, 100000, "", "optical_flow", "corners kept, sparse engine with native targets"
    )
    corner_quality: float = number(
        0.01,
        1e-6,
        1.0,
        "",
        "optical_flow",
        "weakest corner kept, as a fraction of the strongest, sparse engine with native targets",
    )
    corner_distance_px: float = number(
        5.0, 0.0, 100.0, "px", "optical_flow", "least distance between corners, same"
    )
    dense_window_px: int = number(
        5, 3, 51, "px", "optical_flow", "side of the dense engine's weighted window (made odd)"
    )
    dense_noise_threshold: float = number(
        4.0,
        0.0,
        1e6,
        "",
        "optical_flow",
        "an eigenvalue of the dense engine's matrix below this many times its value for pure"
        " noise is taken as zero",
    )
    dense_pyramid_levels: int = number(
        2,
        0,
        8,
        "",
        "optical_flow",
        "pyramid levels above the image, dense engine; 0: as published",
    )
    dense_iterations: int = number(
        3, 1, 20, "", "optical_flow", "warp-and-solve rounds per level, dense engine; 1: published"
    )
    dense_min_speed_px: float = number(
        0.1,
        0.0,
        10.0,
        "px",
        "optical_flow",
        "displacement per frame above which a pixel belongs to a region of the map of speeds",
    )
    star_field_model: str = choice(
        "similarity shift mean",
        "star_field",
        "similarity: robust fit of shift, rotation and scale; shift: of a shift; mean: mean and"
        " std of the velocities with outliers removed, as published",
    )
    outlier_sigmas: float = number(
        2.0,
        0.5,
        20.0,
        "",
        "star_field",
        "a velocity further than this many std from the mean is left out, model mean",
    )
    rso_test: str = choice(
        "history vector speed",
        "detection",
        "history: an RSO shines where the last frames show no star, or drifts, along a path that"
        " chance does not explain; vector: its velocity differs from the star field's by more than"
        " its uncertainty, two frames alone; speed: its speed lies outside mean +- k std, as"
        " published",
    )
    rso_sigmas: float = number(
        6.0,
        0.5,
        100.0,
        "",
        "detection",
        "k of the RSO test, in sigmas of the vector or the speed; tests vector and speed",
    )
    spot_sigmas: float = number(
        3.0,
        1.0,
        100.0,
        "",
        "detection",
        "least brightness over the star field's of what may be an RSO, in sigmas; test history",
    )
    min_relative_px: float = number(
        0.3,
        0.0,
        10.0,
        "px",
        "detection",
        "least displacement per frame against the star field, test vector",
    )
    history_frames: int = number(
        9,
        3,
        100,
        "frames",
        "tracking",
        "frames that are compared, the current one included; more finds slower and fainter RSOs",
    )
    false_tracks: float = number(
        1e-3,
        1e-12,
        1.0,
        "",
        "tracking",
        "a track is confirmed when chance gives fewer such tracks than this in a frame",
    )
    max_speed_px: float = number(
        150.0, 1.0, 10000.0, "px", "tracking", "fastest motion against the stars, per frame"
    )
    coast_frames: int = number(
        5, 0, 1000, "frames", "tracking", "a track unseen in more frames in a row ends"
    )
    max_gap_s: float = number(
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
