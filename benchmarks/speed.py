# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""How fast `Pipeline` is, and how much memory it takes, beside yardsticks of the same run.

``python -m benchmarks.speed`` prints Markdown tables.  Times on shared machines drift, so each is
told against **S**, what a careful user of SExtractor's library would run on the same frame
(`sep.Background`, then `sep.extract` above 3 sigma), and **C**, copying the frame (`np.copyto`).
Each row has a process of its own, so that its peak memory is its own, and counts from when the
history is full and the sensor is learned.  ``--quick`` takes a sixteenth of the pixels and stars:
to see that it works.
"""

from __future__ import annotations

import argparse
import io
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from tqdm import tqdm

from ofsat_ros.cli import main as ofsat
from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import Pipeline
from ofsat_ros.recordings import BagWriter, Frame, open_recording
from ofsat_ros.simulation import scenario

Image = NDArray[np.uint16]

# From when the history is full, and the sensor is learned (16 frames).
_FULL = max(Parameters.preset("robust").history_frames, 17)
_MEASURED = 3
_FRAMES = _FULL + _MEASURED
# arcsec/s; along x only, so that the mirrored sky of `_fourfold` moves alike.
_CAMERA_RATE = (2.0, 0.0)
_STAGES_S = ("preprocessing", "objects", "star_field", "optical_flow", "detection", "tracking")
_MB = 1e6


@dataclass(frozen=True)
class Sky:
    """What is rendered: size in px and count of stars; `fourfold` is put together of quarters."""

    width: int
    height: int
    stars: int
    fourfold: bool = False

    def __str__(self) -> str:
        return f"{self.width}x{self.height}, {self.stars:,} stars"

    @property
    def rendered(self) -> Sky:
        """What of it the simulator renders."""
        if not self.fourfold:
            return self
        return Sky(self.width // 2, self.height // 2, self.stars // 4)

    def scaled(self, divisor: int) -> Sky:
        """The same density on sides that are shorter by a factor."""
        size = (self.width // divisor, self.height // divisor, self.stars // divisor**2)
        return Sky(*size, self.fourfold)


HEADLINE = (Sky(1024, 1024, 600), Sky(1936, 1216, 1000), Sky(4096, 4096, 3000))
PIXELS = (
    Sky(1024, 1024, 188),
    Sky(2048, 2048, 750),
    Sky(4096, 4096, 3000),
    Sky(8192, 8192, 12000, fourfold=True),
)
OBJECTS = tuple(Sky(4096, 4096, n, True) for n in (1250, 2500, 5000, 10_000, 20_000))
LARGEST = HEADLINE[-1]
BAG = HEADLINE[1]


@dataclass(frozen=True)
class Row:
    """Times of one sky, s, and peak memory, bytes."""

    ours: list[float]
    stages: dict[str, float]
    sep: float
    copy: float
    peak: float
    objects: int

    @property
    def ratio(self) -> float:
        """Ours, as the median, in units of S."""
        return float(np.median(self.ours)) / self.sep


def machine() -> str:
    """Say on what this runs: processor, cores, memory, versions."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        named = [
            line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        name = named[0].partition(":")[2].strip() if named else name
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    versions = {"NumPy": np, "OpenCV": cv2, "SciPy": scipy}
    told = ", ".join(f"{key} {module.__version__}" for key, module in versions.items())
    return (
        f"{name}, {len(os.sched_getaffinity(0))} cores, {memory:.0f} GB;"
        f" {platform.system()} {platform.release()}, Python {platform.python_version()}, {told}"
    )


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a process of its own, and return what it returns."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def render(folder: Path, sky: Sky, frames: int, rate: tuple[float, float] = _CAMERA_RATE) -> None:
    """Write the frames of a sky as ``<sky>/<number>.npy``."""
    place = folder / f"{sky}"
    place.mkdir(parents=True, exist_ok=True)
    simulated = scenario(
        "survey",
        1,
        width=sky.width,
        height=sky.height,
        frames=frames,
        star_count=float(sky.stars),
        camera_rate_arcsec_s=rate,
    )
    for number, frame in enumerate(simulated):
        np.save(place / f"{number}.npy", frame.image)


def load(folder: Path, sky: Sky, number: int, frames: int = _FRAMES) -> Image:
    """Return a frame of a sky."""
    place = folder / f"{sky.rendered}"
    image = np.load(place / f"{number}.npy")
    return (
        _fourfold(image, np.load(place / f"{frames - 1 - number}.npy")) if sky.fourfold else image
    )


def _fourfold(image: Image, mirror: Image) -> Image:
    """Four skies that move alike along x: as it is, upside down, and both mirrored and backwards.

    No part is another one shifted, which the star field's vote would take for a second motion.
    """
    return np.block([[image, image[::-1]], [mirror[:, ::-1], mirror[::-1, ::-1]]])


def stamp_ns(number: int) -> int:
    """Stamp of a frame, one each second."""
    return number * 1_000_000_000


def measure(folder: Path, sky: Sky, preset: str) -> Row:
    """Measure one row; to be called in a process of its own."""
    import sep

    pipeline = Pipeline(Parameters.preset(preset))
    ours, stages, others, copies, peak = [], [], [], [], 0.0
    for number in range(_FRAMES):
        image = load(folder, sky, number)
        taken, result = _timed(pipeline.process, image, stamp_ns(number))
        if number < _FULL:
            continue
        ours.append(taken)
        stages.append(result.seconds)
        peak = peak or _peak_bytes()  # before the yardsticks take theirs
        copies += [_timed(np.copyto, np.empty_like(image), image)[0] for _ in range(3)][1:]
        # SExtractor's largest image buffers: it would stop, and its user would enlarge them.
        sep.set_extract_pixstack(max(300_000, image.size // 10))
        values = image.astype(np.float32)
        others.append(_timed(_sep, values)[0])
    medians = {s: float(np.median([one.get(s, 0.0) for one in stages])) for s in stages[-1]}
    return Row(ours, medians, min(others), min(copies), peak, len(result.objects))


def _sep(values: NDArray[np.float32]) -> None:
    import sep

    background = sep.Background(values)
    sep.extract(values - background, 3.0, err=background.globalrms)


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    start_s = time.perf_counter()
    done = function(*arguments)
    return time.perf_counter() - start_s, done


def _peak_bytes() -> float:
    # Not getrusage: what it tells goes back to before the fork, to the process that started this.
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def _resident_bytes() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def memory(folder: Path, sky: Sky, count: int, prepared: int) -> tuple[dict[int, float], float]:
    """Resident memory after so many frames, and the peak, bytes.

    The camera of the prepared frames stands still; rolled by 2 px more each frame, they last.
    """
    pipeline = Pipeline()
    images = [load(folder, sky, number) for number in range(prepared)]
    after, marks = {}, {50, *np.linspace(50, count, 5).astype(int).tolist()}
    for number in tqdm(range(count), desc="memory", leave=False, disable=None):
        image = np.roll(images[number % prepared], 2 * number, axis=1)
        pipeline.process(image, stamp_ns(number))
        if number + 1 in marks:
            after[number + 1] = _resident_bytes()
    return after, _peak_bytes()


def process_bag(folder: Path, sky: Sky) -> tuple[float, float, float]:
    """Seconds to read a bag, to process its frames, and of ``ofsat process`` over it."""
    bag = folder / "bag"
    with BagWriter(bag) as writer:
        for number in range(_FRAMES):
            writer.write_image("/image", load(folder, sky, number), 1 + stamp_ns(number), "camera")
    command = ["process", f"{bag}", "--output", f"{folder / 'results'}", "--force", "--no-report"]
    read_s, process_s, command_s = [], [], []
    for _ in range(2):
        with open_recording(bag) as recording:
            taken, frames = _timed(list, recording)
        read_s.append(taken)
        process_s.append(_timed(_process, frames)[0])
        with redirect_stdout(io.StringIO()):
            command_s.append(_timed(ofsat, command, None, None, False)[0])
    return min(read_s), min(process_s), min(command_s)


def _process(frames: list[Frame]) -> None:
    pipeline = Pipeline()
    for frame in frames:
        pipeline.process(frame.image, frame.stamp_ns)
    pipeline.finish()


def start_s(code: str) -> float:
    """Seconds that a fresh Python takes for a line of code, at its best of four."""
    command = [sys.executable, "-c", code]
    return min(_timed(lambda: subprocess.run(command, check=True))[0] for _ in range(4))


def tables(folder: Path, quick: bool, memory_frames: int, jobs: int) -> Iterator[str]:
    """Yield the tables, each as soon as it is known."""
    scale = 4 if quick else 1
    skies = {sky: sky.scaled(scale) for sky in (*HEADLINE, *PIXELS, *OBJECTS)}
    _render_all(folder, {sky.rendered for sky in skies.values()}, jobs)
    rows: dict[tuple[Sky, str], Row] = {}
    wanted = [(sky, "robust") for sky in skies] + [(sky, "paper_opencv") for sky in HEADLINE]
    for sky, preset in tqdm(wanted, desc="measuring", disable=None):
        rows[sky, preset] = alone(measure, folder, skies[sky], preset)

    yield _heading("Steady state, preset robust")
    yield _speed_table({f"{skies[sky]}": rows[sky, "robust"] for sky in HEADLINE})
    yield _heading("The published method: preset paper_opencv")
    yield _speed_table({f"{skies[sky]}": rows[sky, "paper_opencv"] for sky in HEADLINE})
    yield _heading("Growth with pixels, at the same density of stars")
    yield _speed_table({f"{skies[sky]}": rows[sky, "robust"] for sky in PIXELS})
    yield _heading("Growth with objects")
    yield _speed_table({f"{skies[sky]}": rows[sky, "robust"] for sky in OBJECTS})
    yield _heading("Stages, ms")
    yield _stage_table({f"{skies[sky]}": rows[sky, "robust"] for sky in skies})

    yield _heading("Memory, start, command")
    yield from _other_rows(folder, skies[LARGEST], skies[BAG], memory_frames)


def _other_rows(folder: Path, largest: Sky, bag: Sky, memory_frames: int) -> Iterator[str]:
    yield "| what | measured |\n|---|---|"
    read_s, process_s, command_s = alone(process_bag, folder, bag)
    yield (
        f"| `ofsat process`, {_FRAMES} frames of {bag} | {command_s / (read_s + process_s):.2f} x"
        f" of reading ({read_s:.2f} s) + `process` alone ({process_s:.2f} s) |"
    )
    import_s = start_s("import ofsat_ros.pipeline")
    first = "import numpy; Pipeline().process(numpy.eye(1024, dtype='u2'), 0)"
    first_s = start_s(f"from ofsat_ros.pipeline import Pipeline; {first}")
    others_s = start_s("import numpy, cv2")
    yield (
        f"| a fresh Python: `import ofsat_ros.pipeline` | {import_s:.2f} s, of which Python,"
        f" NumPy and OpenCV take {others_s:.2f} s |"
    )
    yield f"| a fresh Python to `Pipeline`'s first answer, 1024x1024 | {first_s:.2f} s |"
    prepared = 6
    alone(render, folder, largest, prepared, (0.0, 0.0))
    after, peak = alone(memory, folder, largest, memory_frames, prepared)
    told = ", ".join(f"{size / _MB:,.0f} MB after {count:,}" for count, size in after.items())
    yield f"| resident memory at {largest}, {prepared} of its frames held | {told} frames |"
    yield f"| its peak | {peak / _MB:,.0f} MB |"


def _render_all(folder: Path, skies: set[Sky], jobs: int) -> None:
    ordered = sorted(skies, key=lambda sky: -sky.width * sky.height)
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        done = [pool.submit(render, folder, sky, _FRAMES) for sky in ordered]
        for one in tqdm(done, desc="rendering", disable=None):
            one.result()


def _heading(text: str) -> str:
    return f"\n### {text}\n"


def _speed_table(rows: dict[str, Row]) -> str:
    lines = [
        "| frame | ours, ms: median | least | S, ms | C, ms | ours / S | frames/s | peak RSS, MB"
        " | objects |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        median = float(np.median(row.ours))
        lines.append(
            f"| {name} | {1e3 * median:.1f} | {1e3 * min(row.ours):.1f} | {1e3 * row.sep:.1f}"
            f" | {1e3 * row.copy:.2f} | {row.ratio:.2f} | {1 / median:.1f}"
            f" | {row.peak / _MB:,.0f} | {row.objects:,} |"
        )
    return "\n".join(lines)


def _stage_table(rows: dict[str, Row]) -> str:
    stages = [s for s in _STAGES_S if any(s in row.stages for row in rows.values())]
    stages += sorted({s for row in rows.values() for s in row.stages} - set(stages))
    head = ["frame", *(stage.replace("_", " ") for stage in stages)]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name, row in rows.items():
        cells = [name, *(f"{1e3 * row.stages.get(stage, 0.0):.1f}" for stage in stages)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Measure the pipeline's speed and memory.")
    parser.add_argument("--quick", action="store_true", help="a sixteenth of pixels and stars")
    parser.add_argument("--out", type=Path, help="also write the tables to this file")
    parser.add_argument(
        "--memory-frames",
        type=int,
        default=100,
        help="frames over which memory is watched (default: %(default)s; at least 50)",
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="processes that render (default: %(default)s)"
    )
    options = parser.parse_args()
    try:
        import sep
    except ModuleNotFoundError:
        sys.exit("speed: the yardstick S needs sep: pip install sep")
    parts = [f"{machine()}, sep {sep.__version__}"]
    print(parts[0], flush=True)
    with tempfile.TemporaryDirectory(prefix="ofsat_speed_") as folder:
        for part in tables(
            Path(folder), options.quick, max(50, options.memory_frames), options.jobs
        ):
            print(part, flush=True)
            parts.append(part)
    if options.out:
        options.out.write_text("\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
