# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a night does to the sky and the sensor: nothing is invented, what comes back is found.

Each fault befalls a plain scene: stars that drift, two RSOs among them.
"""

import math
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
import pytest
from blobs import blobs, flux_of_snr, scattered
from sky import SECOND_NS

from ofsat_ros.parameters import Parameters
from ofsat_ros.pipeline import FrameResult, Pipeline
from ofsat_ros.tracking import Settled

SIDE, FRAMES, SIGMA = 160, 24, 1.2
LEVEL, NOISE = 600.0, 25.0
DRIFT = np.array([1.3, -0.7])
# The fault is over after this frame.
OVER = 15

Places = list[tuple[float, float]]
Shot = tuple[np.ndarray, Places]


class Scene:
    """Light of stars and RSOs, and images of it."""

    def __init__(self, seed: int = 1, spacing: float = 17, rsos: int = 2) -> None:
        self.random = random = np.random.default_rng(seed)
        margin = 40
        wide = SIDE + 2 * margin
        self.stars = scattered(random, (wide, wide), spacing) - margin
        snr = 10 ** random.uniform(0.9, 2.3, len(self.stars))
        self.flux = flux_of_snr(snr, NOISE, SIGMA)
        # In the sensor, as a camera that stands still sees them pass.
        turn = random.uniform(0, 2 * math.pi) + np.arange(rsos) * 2.4
        self.steps = np.array([3.2, 4.4])[:rsos, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
        self.middles = random.uniform(0.4, 0.6, (rsos, 2)) * SIDE
        self.rso_flux = flux_of_snr(np.array([40.0, 25.0])[:rsos], NOISE, SIGMA)

    def places(self, frame: float) -> np.ndarray:
        return self.middles + self.steps * (frame - FRAMES / 2)

    def light(self, frame: int, sigma: float = SIGMA) -> np.ndarray:
        stars = self.stars + DRIFT * (frame - FRAMES / 2)
        inside = ((stars > -8) & (stars < SIDE + 8)).all(axis=1)
        xy = np.concatenate([stars[inside], self.places(frame)])
        flux = np.concatenate([self.flux[inside], self.rso_flux])
        return blobs((SIDE, SIDE), xy, flux, sigma)

    def truth(self, frame: float) -> Places:
        return [tuple(place) for place in self.places(frame)]

    def expose(self, light: np.ndarray, level: np.ndarray | float = LEVEL) -> np.ndarray:
        """Photon noise, and a tenth of it that the sensor adds; full at 65535 DN."""
        light = np.maximum(light + level, 0)
        noise = np.sqrt(light / LEVEL * NOISE**2 + (NOISE / 10) ** 2)
        image = light + noise * self.random.normal(0, 1, light.shape) + 100
        return np.clip(np.rint(image), 0, 65535).astype(np.uint16)

    def image(self, frame: int) -> np.ndarray:
        return self.expose(self.light(frame))


class Watched:
    """What the pipeline says of shots, against the truth."""

    def __init__(self, shots: Iterator[Shot]) -> None:
        pipeline = Pipeline(Parameters.preset())
        self.results: list[FrameResult] = []
        settled: list[Settled] = []
        truths = []
        for number, (image, places) in enumerate(shots):
            self.results.append(pipeline.process(image, (number + 1) * SECOND_NS))
            settled += self.results[-1].settled
            truths.append(places)
        settled += pipeline.finish()
        assert [one.frame for one in settled] == list(range(len(truths)))
        self.false, self.seen = [], []
        for said in ([r.detections for r in self.results], [s.detections for s in settled]):
            rows = [(k, row) for k, found in enumerate(said) for row in found if row["track_id"]]
            self.seen.append(np.zeros(len(truths), int))
            for frame, row in rows:
                # A star that it passes, or a fault, may pull it, or hide it from its track.
                if any(math.dist((row["x"], row["y"]), place) < 6 for place in truths[frame]):
                    self.seen[-1][frame] += 1
                else:
                    self.false.append((frame, *row[["x", "y", "snr", "track_id"]].tolist()))

    def recovers(self, after: int, within: int = 3) -> bool:
        """Whether the live view has both RSOs again so many frames after a fault."""
        return bool(np.all(self.seen[0][after + within : FRAMES - 3] >= 1))


def cover(frame: int) -> float:
    """How much a cloud lets through that comes at frame 8 and has gone at `OVER`."""
    return float(np.clip(abs(frame - 11.5) - 1.5, 0, 2) / 2)


def pattern(random: np.random.Generator, size: int, finest_px: float) -> np.ndarray:
    """Clouds: noise without what is finer, with Kolmogorov's slope, from 0 to 1."""
    waves = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    slope = np.maximum(waves, 2 / size) ** (-11 / 6) * np.exp(-((waves * finest_px) ** 2))
    clouds = np.fft.irfft2(np.fft.rfft2(random.normal(size=(size, size))) * slope)
    return (clouds - clouds.min()) / np.ptp(clouds)


def clouds(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        light = cover(k)
        yield scene.expose(scene.light(k) * light, LEVEL * (2 - light)), scene.truth(k)


def moonlit_clouds(scene: Scene) -> Iterator[Shot]:
    """With more structure than there are stars: it moves as one, like an RSO."""
    wisps = pattern(scene.random, 2 * SIDE, 20)
    for k in range(FRAMES):
        left = 2 * k
        seen = np.clip(wisps[left : left + SIDE, k : k + SIDE] * 3 - 1, 0, 1) * (5 < k <= OVER)
        yield scene.expose(scene.light(k) * (1 - seen), LEVEL * (1 + 20 * seen)), scene.truth(k)


def dawn(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        bright = 100 ** np.clip((k - 10) / 10, 0, 1.2) * np.linspace(1, 1.5, SIDE)[:, None]
        yield scene.expose(scene.light(k), LEVEL * bright), scene.truth(k)


def shutter(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        closed = 10 < k <= OVER
        yield scene.expose(scene.light(k) * (not closed), LEVEL * (not closed)), scene.truth(k)


def dew(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        yield scene.expose(scene.light(k, 1.1 + 0.08 * k)), scene.truth(k)


def lightning(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        glow = np.linspace(10, 60, SIDE) if k in (9, OVER) else 1
        yield scene.expose(scene.light(k), LEVEL * glow), scene.truth(k)


def saturated(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        image = scene.image(k)
        yield np.full_like(image, 65535) if k in (8, 13, 14, OVER) else image, scene.truth(k)


def masked(scene: Scene) -> Iterator[Shot]:
    """Stars go under a masked patch and come out on the other side."""
    for k in range(FRAMES):
        image = scene.image(k).astype(np.float32)
        image[10:50, 20:60] = np.nan
        yield image, scene.truth(k)


def lost_rows(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        image = scene.image(k)
        if k % 5 == 3 and k <= OVER:
            image[scene.random.integers(30, SIDE - 30) :] = 0
        yield image, scene.truth(k)


def torn(scene: Scene) -> Iterator[Shot]:
    """The lower part of some frames is the one before's."""
    last = scene.image(0)
    for k in range(FRAMES):
        image = scene.image(k)
        shown, row = image.copy(), scene.random.integers(30, SIDE - 30)
        if k % 6 == 5 and k <= OVER:
            shown[row:] = last[row:]
        last = image
        yield shown, scene.truth(k) + scene.truth(k - 1)


def repeated(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        shown = 9 if k in (10, 11) else k
        yield scene.image(shown), scene.truth(shown)


def glitched_rows(scene: Scene) -> Iterator[Shot]:
    for k in range(FRAMES):
        image = scene.image(k).astype(int)
        for row in scene.random.integers(0, SIDE, 3) if k <= OVER else ():
            first, last = np.sort(scene.random.integers(0, SIDE, 2))
            image[row, first:last] += scene.random.integers(50, 3000)
        yield image.clip(0, 65535).astype(np.uint16), scene.truth(k)


FAULTS: dict[str, Callable[[Scene], Iterator[Shot]]] = {
    fault.__name__: fault
    for fault in (
        clouds,
        moonlit_clouds,
        dawn,
        shutter,
        dew,
        lightning,
        saturated,
        masked,
        lost_rows,
        torn,
        repeated,
        glitched_rows,
    )
}


@pytest.mark.parametrize("name", FAULTS)
def test_nothing_is_invented_and_what_is_seen_again_is_found(name: str):
    watched = Watched(FAULTS[name](Scene(seed=3)))
    assert watched.false == []
    if name != "dawn":
        assert watched.recovers(OVER), watched.seen


def test_a_crowded_field_under_a_mask_brings_nothing_new():
    """A star every 9 px: as many come out from under the mask as RSOs would not."""
    scene = Scene(seed=2, spacing=9, rsos=0)
    assert Watched(islice(masked(scene), 14)).false == []


def test_thick_moonlit_clouds_are_called_so():
    results = Watched(moonlit_clouds(Scene(seed=1))).results
    words = "most of the image is structure, not noise: clouds or bands hide what is faint"
    assert words in {result.reason for result in results[6 : OVER + 1]}
    assert words not in {result.reason for result in results[:6] + results[OVER + 1 :]}


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_stars_and_nothing_else(count: int):
    scene = Scene(seed=4, rsos=0)
    near = np.argsort(np.hypot(*(scene.stars - SIDE / 2).T))[:count]
    scene.stars, scene.flux = scene.stars[near], scene.flux[near]
    watched = Watched((scene.image(k), []) for k in range(FRAMES))
    assert watched.false == []


def test_twenty_satellites_in_a_row_are_twenty_tracks():
    scene = Scene(seed=5, rsos=1)
    step, gap = scene.steps[0] * 1.5, 2.4
    train = [SIDE / 2 + step * (gap * (i - 9.5) - FRAMES / 2) for i in range(20)]
    scene.steps, scene.middles = np.repeat([step], 20, axis=0), np.array(train) + step * FRAMES / 2
    scene.rso_flux = np.repeat(flux_of_snr(30.0, NOISE, SIGMA), 20)
    watched = Watched((scene.image(k), scene.truth(k)) for k in range(FRAMES))
    assert watched.false == []
    inside = [
        np.count_nonzero(((p > 4) & (p < SIDE - 5)).all(axis=1))
        for p in (scene.places(k) for k in range(FRAMES))
    ]
    # Each counts from its third frame on; one in three may cross a star.
    assert np.sum(watched.seen[1]) > 0.67 * np.sum(inside)
    ids = {int(i) for r in watched.results for i in r.tracks["track_id"]}
    assert len(ids) <= 24


def test_an_aircraft_is_a_few_tracks_and_no_burst():
    """Three lights and a flash: something crosses the field, and what it is, is not said."""
    scene = Scene(seed=6, rsos=0)
    way, lights = np.array([14.0, 5.0]), np.array([(0, 0), (-12, 4), (-4, -12)])

    def shots() -> Iterator[Shot]:
        for k in range(FRAMES):
            place = lights + SIDE / 2 + way * (k - FRAMES / 2)
            flux = flux_of_snr(np.array([900.0, 300.0, 300.0]), NOISE, SIGMA)
            light = scene.light(k) + blobs((SIDE, SIDE), place, flux, 2.0, tuple(way))
            if k % 2:
                flash = flux_of_snr(900, NOISE, SIGMA)
                light += blobs((SIDE, SIDE), place[:1] + 3, flash, 2.0)
            # Wherever it is in its streaks.
            yield (
                scene.expose(light),
                [tuple(p + way * part) for p in place for part in np.linspace(-0.6, 0.6, 7)],
            )

    watched = Watched(shots())
    assert watched.false == []
    ids = {int(i) for result in watched.results for i in result.tracks["track_id"]}
    assert 1 <= len(ids) <= 4
