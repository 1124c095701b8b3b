# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The paper's results, reproduced: both engines over its two scenes, with its noise.

``python -m benchmarks.paper`` prints Markdown tables: the published presets, sparse beside dense,
and the default, which looks back, with either engine.  ``--frames`` and ``--brightness`` shorten
or vary it.  The figures in docs/algorithm.md are this program's output.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass, field

import cv2
import numpy as np
from tqdm import tqdm

from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.simulation import RSO, SimulatedFrame, scenario

_MATCH_PX = 2.0
_METHODS = {
    "paper_opencv (sparse)": Parameters.preset("paper_opencv"),
    "paper_matlab (dense)": Parameters.preset("paper_matlab"),
    "robust, sparse": Parameters.preset("robust", engine="sparse"),
    "robust, dense": Parameters.preset("robust", engine="dense"),
}
_SCENES = ("geo", "sidereal")


@dataclass
class Score:
    """What one method made of one scene."""

    present: int = 0  # RSOs times frames that could be compared with an earlier one
    found: int = 0
    objects: dict[int, int] = field(default_factory=dict)  # frames in which each was found
    false_alarms: int = 0
    frames: int = 0
    errors_px: list[float] = field(default_factory=list)  # of velocity, px per frame
    field_px: list[float] = field(default_factory=list)  # of the star field's motion
    seconds: list[float] = field(default_factory=list)


def run(parameters: Parameters, frames: list[SimulatedFrame]) -> Score:
    """Process a scene and compare each frame with its truth."""
    pipeline, score = Pipeline(parameters), Score()
    settled = []
    for frame in frames:
        start = time.perf_counter()
        result = pipeline.process(frame.image, frame.stamp_ns)
        score.seconds.append(time.perf_counter() - start)
        settled += result.settled
        if result.star_field is not None:
            error = result.star_field.displacement - frame.displacement_px
            score.field_px.append(float(np.hypot(*error)))
    settled += pipeline.finish()
    period_s = (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9 / (len(frames) - 1)
    # The first frame has no other before it.
    for frame, last in zip(frames[1:], settled[1:], strict=True):
        score.frames += 1
        score.present += len(frame.truth)
        _compare(last.detections, frame.truth, period_s, score)
    return score


def _compare(detections: np.ndarray, truth: np.ndarray, dt_s: float, score: Score) -> None:
    """Match one to one, the nearest pairs first."""
    dx = detections["x"][:, None] - truth["x_px"][None]
    dy = detections["y"][:, None] - truth["y_px"][None]
    distance = np.hypot(dx, dy)
    score.false_alarms += len(detections)
    while distance.size and distance.min() <= _MATCH_PX:
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        distance[i, :] = distance[:, j] = np.inf
        rso = int(truth["id"][j])
        score.found += 1
        score.objects[rso] = score.objects.get(rso, 0) + 1
        score.false_alarms -= 1
        dvx = detections["vx"][i] - truth["vx_px_s"][j]
        dvy = detections["vy"][i] - truth["vy_px_s"][j]
        score.errors_px.append(float(np.hypot(dvx, dvy)) * dt_s)


def render(scene: str, frames: int | None, brightness: float, seed: int) -> list[SimulatedFrame]:
    """Render a scene, its RSOs made brighter or fainter by a factor."""
    size = {"frames": frames} if frames else {}
    rsos = tuple(
        RSO(rso.position_px, rso.rate_arcsec_s, rso.flux_percent * brightness)
        for rso in scenario(scene, seed, **size).rsos
    )
    return list(scenario(scene, seed, **size, rsos=rsos))


def table(scene: str, scores: dict[str, Score], snr: float, rsos: int) -> str:
    """Return one scene's Markdown table."""
    lines = [
        f"### `{scene}`: {rsos} RSO{'s' * (rsos > 1)}, median SNR {snr:.0f}",
        "",
        "| method | RSOs found in half their frames | frames x RSOs found | false alarms per frame"
        " | velocity error, median px/frame | star-field error, median px/frame | ms per frame |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, s in scores.items():
        half = sum(count * rsos * 2 >= s.present for count in s.objects.values())
        lines.append(
            f"| {name} | {half} of {rsos} | {s.found} of {s.present}"
            f" | {s.false_alarms / max(s.frames, 1):.2f} | {_median(s.errors_px)}"
            f" | {_median(s.field_px)} | {1e3 * np.median(s.seconds):.0f} |"
        )
    return "\n".join(lines) + "\n"


def _median(values: list[float]) -> str:
    return f"{np.median(values):.2f}" if values else "-"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Reproduce the results of AAS 21-364.")
    parser.add_argument("--frames", type=int, help="frames per scene; default: the scene's own")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--brightness",
        type=float,
        nargs="+",
        default=[10.0, 1.0, 0.3],
        help="factors on the RSOs' flux (default: %(default)s)",
    )
    options = parser.parse_args()
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, OpenCV {cv2.__version__},"
        f" {cv2.getNumberOfCPUs()} cores, seed {options.seed}, noise 5 % mean\n"
    )
    cases = [(scene, factor) for scene in _SCENES for factor in options.brightness]
    for scene, factor in cases:
        frames = render(scene, options.frames, factor, options.seed)
        truth = np.concatenate([frame.truth for frame in frames])
        scores = {
            name: run(parameters, frames)
            for name, parameters in tqdm(_METHODS.items(), desc=scene, leave=False, disable=None)
        }
        rsos = len(np.unique(truth["id"]))
        print(table(scene, scores, float(np.median(truth["snr"])), rsos), flush=True)


if __name__ == "__main__":
    main()
