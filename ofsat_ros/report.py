"""Pictures of what was found: the last step, for people.

`annotate` draws one frame; the detector node publishes it, the recorder keeps some of them.
`summary` says in a line what there is.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from ofsat_ros.detection import CONFIRMED
from ofsat_ros.pipeline import FrameResult
from ofsat_ros.tracking import COASTING

# BGR
_STAR, _RSO, _COASTING = (255, 150, 60), (70, 70, 255), (60, 220, 250)
_TEXT = (235, 235, 235)
# Points are drawn to a sixteenth of a pixel (cv2's fixed-point drawing).
_SHIFT = 4
_SHORTEST_SIDE = 480
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# px; half the side of the box around an RSO, beyond half its streak.
_BOX_MARGIN_PX = 8
# Part of a side that the corner of an open box is long.
_CORNER = 0.3


def annotate(
    image: NDArray[np.generic], result: FrameResult, scale: float = 5.0
) -> NDArray[np.uint8]:
    """Draw what was found over the image.

    Stars' flow in blue; each confirmed RSO in a red box with its flow, id, speed and SNR; of a
    candidate's box only the corners, and no id; a yellow box where a coasting track is expected.
    A line on top says how many there are, or why there is none.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        The image, DN.
    result : FrameResult
        What it gave.
    scale : float
        Length of a drawn vector, in frames of motion.

    Returns
    -------
    (h, w, 3) uint8
        The picture, BGR; as large as the image, or an integer multiple if that is small.
    """
    zoom = max(1, -(-_SHORTEST_SIDE // min(image.shape)))
    gray = cv2.resize(
        _stretch(image, result), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST
    )
    picture = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    flow, stars = result.flow, result.star_rows
    _draw_vectors(picture, flow.position[stars], flow.displacement[stars] * scale, zoom, _STAR)
    for rso in result.detections:
        _draw_rso(picture, rso, result.dt_s * scale, zoom)
    for track in result.tracks[result.tracks["status"] == COASTING]:
        _draw_box(picture, track, zoom, _COASTING, True, f"#{track['track_id']} coasting")
    _draw_caption(picture, result)
    return picture


def summary(result: FrameResult) -> str:
    """Say how many RSOs a frame shows, or why there is none."""
    if result.reason:
        return result.reason
    confirmed = int(np.count_nonzero(result.detections["status"] == CONFIRMED))
    candidates = len(result.detections) - confirmed
    coasting = int(np.count_nonzero(result.tracks["status"] == COASTING))
    words = f"{confirmed} RSO{'s' * (confirmed != 1)}" if confirmed else "no confirmed RSO"
    if candidates:
        words += f", {candidates} candidate{'s' * (candidates != 1)}"
    if coasting:
        words += f", {coasting} coasting"
    return words


def _stretch(image: NDArray[np.generic], result: FrameResult) -> NDArray[np.uint8]:
    """8 bits that show faint stars: asinh over the background, in units of its noise."""
    noise = result.noise if np.isfinite(result.noise) and result.noise > 0 else 1.0
    level = result.background
    if not np.isfinite(level):
        level = float(np.median(image.astype(np.float32)))
    if image.dtype.kind == "u":  # of each value that there may be, not of each pixel
        values = np.arange(256**image.dtype.itemsize, dtype=np.float32)
        return _asinh(values, level, noise)[image]
    return _asinh(image.astype(np.float32), level, noise)


def _asinh(values: NDArray[np.float32], level: float, noise: float) -> NDArray[np.uint8]:
    with np.errstate(over="ignore"):  # an infinity is shown white
        # The smoothed noise is about a third of the pixel noise; 12 of it are some four of those.
        value = np.maximum((values - np.float32(level)) / np.float32(12 * noise), 0)
    shown = np.arcsinh(np.nan_to_num(value)) * np.float32(55) + np.float32(18)
    return np.minimum(shown, 255).astype(np.uint8)


def _draw_vectors(
    picture: NDArray[np.uint8],
    origins: NDArray[np.float64],
    vectors: NDArray[np.float64],
    zoom: int,
    colour: tuple[int, int, int],
) -> None:
    """Lines from objects to where they go, and a dot on each so that no motion shows, too."""
    starts, ends = _fixed(origins, zoom), _fixed(origins + vectors, zoom)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        cv2.line(picture, start, end, colour, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(picture, start, 2 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)


def _draw_rso(picture: NDArray[np.uint8], rso: np.void, seconds: float, zoom: int) -> None:
    confirmed = rso["status"] == CONFIRMED
    velocity = np.array([rso["vx"], rso["vy"]])
    origin = np.array([rso["x"], rso["y"]])
    _draw_vectors(picture, origin[None], velocity[None] * seconds, zoom, _RSO)
    name = f"#{rso['track_id']} " if confirmed else ""
    label = f"{name}{np.hypot(*velocity):.2f} px/s SNR {rso['snr']:.0f}"
    _draw_box(picture, rso, zoom, _RSO, confirmed, label)


def _draw_box(
    picture: NDArray[np.uint8],
    row: np.void,
    zoom: int,
    colour: tuple[int, int, int],
    closed: bool,
    label: str,
) -> None:
    """A square around a place, or only its corners, and a text to the right of it."""
    centre = np.array([row["x"], row["y"]])
    half = _BOX_MARGIN_PX + np.nan_to_num(row["length"]) / 2
    start, end = (_fixed(centre + way, zoom).tolist() for way in (-half, half))
    if closed:
        cv2.rectangle(picture, start, end, colour, 1, cv2.LINE_AA, _SHIFT)
    else:
        bit = round(_CORNER * (end[0] - start[0]))
        for x, y in product((start[0], end[0]), (start[1], end[1])):
            inwards = (x + (bit if x == start[0] else -bit), y + (bit if y == start[1] else -bit))
            for tip in ((inwards[0], y), (x, inwards[1])):
                cv2.line(picture, (x, y), tip, colour, 1, cv2.LINE_AA, _SHIFT)
    _write(picture, label, (end[0] >> _SHIFT) + 4, (start[1] >> _SHIFT) + 8, colour)


def _draw_caption(picture: NDArray[np.uint8], result: FrameResult) -> None:
    found = summary(result)
    if result.reason:
        found = f"no RSO: {found}"
    line = f"frame {result.frame}: {found}"
    if result.star_field is not None and not result.reason:
        dx, dy = result.star_field.displacement
        line += f"; {result.star_field.star_count} stars move ({dx:+.2f}, {dy:+.2f}) px"
    _write(picture, line, 6, 16, _TEXT)


def _write(
    picture: NDArray[np.uint8], text: str, x: int, y: int, colour: tuple[int, int, int]
) -> None:
    """Text that stays inside the picture and readable on bright ground."""
    (width, _), _ = cv2.getTextSize(text, _FONT, 0.42, 1)
    at = (max(2, min(x, picture.shape[1] - width - 4)), max(12, min(y, picture.shape[0] - 4)))
    cv2.putText(picture, text, at, _FONT, 0.42, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, at, _FONT, 0.42, colour, 1, cv2.LINE_AA)


def _fixed(xy: NDArray[np.float64], zoom: int) -> NDArray[np.int_]:
    """Points of the image in the picture's fixed-point pixels."""
    return np.rint(((xy + 0.5) * zoom - 0.5) * (1 << _SHIFT)).astype(int)
