# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""The motion of the star field: the motion that most objects share.

Fourth stage: takes flow vectors and finds the one motion behind most of them; what follows asks
which objects move otherwise.  `vote_shift` gives the flow its first guess, from the objects alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Objects that take part in a vote: its cost is their number squared.
_VOTERS = 150
# Cells of the coarse vote, along each axis.
_VOTE_CELLS = 512
# A similarity has four parameters, and three without scale; with fewer stars than this their
# scatter goes into them.
_STARS_FOR_SIMILARITY, _STARS_FOR_TURN = 6, 4
# Which of them, of shift x, shift y, scale and rotation, are fitted.
_SHIFT, _TURN, _SIMILARITY = [0, 1], [0, 1, 3], [0, 1, 2, 3]
# Of so many vectors, this part at least must share a motion that is the field's.
_MANY_VECTORS, _LEAST_SHARE = 20, 0.1
# A motion further than this from the expected one, px, needs so many stars, or that part of those
# that showed the expected one: an RSO that the mount follows and wrong vectors make two or three.
_OTHER_PX, _ENOUGH_STARS, _ENOUGH_SHARE = 5.0, 5, 0.5
# A motion is not believed if two unrelated fields show one more often than this; motions so far
# apart, px, carry objects to different places.
_MOST_CHANCE, _APART_PX = 1e-2, 1.5
# A field turns if its rotation is so many of its sigmas.
_SURE_SIGMAS = 5.0
# Cut of Tukey's biweight, in sigmas: 95 % efficiency on Gaussian errors.
_TUKEY = 4.685
# Stars scatter by less than so many times as much as stated.
_DOUBTFUL_SIGMAS = 3.0
# The fit has converged when no vector of the field changes by more than this, px.
_CONVERGED_PX = 1e-4
# What the vectors say so much less of than of the rest, they do not say.
_LEAST_CONDITION = 1e-12


@dataclass(frozen=True)
class StarFieldMotion:
    """Motion of the star field between two frames.

    The displacement of a star at x is ``displacement + A (x - centre)`` with
    ``A = [[s, -r], [r, s]]``: a small rotation r (rad, from x to y) and a scale change s.

    Attributes
    ----------
    centre : (2,) float64
        Centre of the image, px.
    displacement : (2,) float64
        Displacement of the field at the centre, px per frame.
    rotation : float
        rad per frame, from the x axis towards the y axis.
    scale : float
        Relative change of scale per frame, 0 for none.
    covariance : (4, 4) float64
        Of (displacement x, displacement y, scale, rotation); 0 for what was not fitted.
    inliers : (N,) bool
        Flow vectors that move with the field.
    residual_px : float
        Rms of the inliers' residuals, each axis, px.
    residual_sigmas : float
        Their robust std over the stated one: how much worse than stated the vectors are, >= 1.
    speed_mean, speed_std : float
        Of the inliers' speeds, px per frame: what the published test compares with.
    model : str
        What was fitted: mean, shift or similarity (fewer stars allow fewer parameters).
    """

    centre: Array
    displacement: Array
    rotation: float
    scale: float
    covariance: Array
    inliers: NDArray[np.bool_]
    residual_px: float
    residual_sigmas: float
    speed_mean: float
    speed_std: float
    model: str

    @property
    def star_count(self) -> int:
        """Number of vectors that move with the field."""
        return int(np.count_nonzero(self.inliers))

    def with_inliers(self, inliers: NDArray[np.bool_]) -> StarFieldMotion:
        """Return the same motion with the inliers of another, longer, set of vectors."""
        return replace(self, inliers=inliers)

    def led_by(self, matrix: Array) -> StarFieldMotion:
        """Return the same, moving as a matrix (3, 3) from current to previous px says."""
        turn = np.eye(2) - matrix[:2, :2]
        displacement = turn @ self.centre - matrix[:2, 2]
        return replace(
            self,
            displacement=displacement,
            scale=float(turn[0, 0]),
            rotation=float(turn[1, 0]),
        )

    def over(self, times: float) -> StarFieldMotion:
        """Return the motion that goes on evenly for so many times as long."""
        return replace(
            self,
            displacement=self.displacement * times,
            rotation=self.rotation * times,
            scale=self.scale * times,
            covariance=self.covariance * times**2,
            speed_mean=self.speed_mean * times,
            speed_std=self.speed_std * times,
        )

    def is_credible(
        self,
        expected: StarFieldMotion | None,
        objects: tuple[int, int],
        carried: int,
        found: int,
        share: float,
    ) -> bool:
        """Whether it is the motion of one field, and not what two unrelated ones show by chance.

        Parameters
        ----------
        expected : StarFieldMotion or None
            The motion if it goes on as it did; another one needs more stars.
        objects : (int, int)
            Objects of the frame before, and of this one.
        carried, found : int
            Objects of one of the frames that the motion carries into the other, and those of them
            that it carries onto an object there.
        share : float
            Part of the other frame which objects cover.

        Notes
        -----
        Chance carries an object onto another with the probability `share`, and `found` of
        `carried` with at most exp(-`carried` D), where D is the divergence of their share from it
        (Hoeffding 1963, theorem 1).  It has as many tries as there are motions as near to the
        expected one, or pairs of objects that may give one; those that gave it are no evidence.
        """
        if expected is not None and self.is_about(expected):
            off_px = np.hypot(*(self.displacement - expected.displacement))
            tries = max(1.0, float(off_px / _APART_PX) ** 2)
        else:
            if expected is not None and self.star_count < min(
                _ENOUGH_STARS, _ENOUGH_SHARE * expected.star_count
            ):
                return False
            if found == max(objects) == self.star_count:
                return True  # all there is agrees, be it a single star
            given = 2 if self.model == "similarity" else 1
            tries = float(max(1, objects[0] * objects[1])) ** given
            carried, found = carried - given, found - given
        return bool(np.log(tries) + _log_chance(found, carried, share) < np.log(_MOST_CHANCE))

    @property
    def is_doubtful(self) -> bool:
        """Whether it may be that of RSOs: one object's, or one that its vectors contradict."""
        return self.star_count < 2 or self.residual_sigmas > _DOUBTFUL_SIGMAS

    @property
    def turns(self) -> bool:
        """Whether its rotation is more than an error."""
        return abs(self.rotation) > _SURE_SIGMAS * float(np.sqrt(self.covariance[3, 3]))

    def turned_with(self, other: StarFieldMotion) -> StarFieldMotion:
        """Return the same with the rotation of another on top of its own."""
        covariance = self.covariance.copy()
        if not covariance[3, 3]:
            covariance[3, 3] = other.covariance[3, 3]
        return replace(self, rotation=self.rotation + other.rotation, covariance=covariance)

    def is_about(self, other: StarFieldMotion) -> bool:
        """Whether it may be another, at the image's centre."""
        return bool(np.hypot(*(self.displacement - other.displacement)) <= _OTHER_PX)

    def displacement_at(self, xy: Array) -> Array:
        """Displacement of the field at points (N, 2) px of the current frame, (N, 2) px."""
        design = _design(np.asarray(xy, float) - self.centre)
        return design @ np.array([*self.displacement, self.scale, self.rotation])

    def variance_at(self, xy: Array) -> Array:
        """Variance of `displacement_at`, (N, 2) px^2."""
        design = _design(np.asarray(xy, float) - self.centre)
        return np.einsum("nij,jk,nik->ni", design, self.covariance, design)


def estimate_motion(
    position: Array,
    displacement: Array,
    sigma: Array,
    speed: Array,
    shape: tuple[int, int],
    model: str = "similarity",
    outlier_sigmas: float = 2.0,
    expected: StarFieldMotion | None = None,
) -> StarFieldMotion | None:
    """Find the motion that most vectors share.

    Parameters
    ----------
    position, displacement, sigma : (N, 2) float64
        Valid flow vectors: end, displacement and its std, px.
    speed : (N,) float64
        Their speeds, px per frame.
    shape : (height, width)
        Size of the image, px.
    model : {"similarity", "shift", "mean"}
        similarity, shift: least squares with Tukey's biweight, started from the vectors' mode.
        mean: the mean after outliers of speed are removed, as published (AAS 21-364).
    outlier_sigmas : float
        What the model mean removes, in std.
    expected : StarFieldMotion, optional
        The motion if it goes on as it did: the model similarity takes its rotation where stars
        are too few to show theirs.

    Returns
    -------
    StarFieldMotion or None
        None if there is no vector, no two that agree where there are several, or fewer than a
        tenth of many.
    """
    if not len(position):
        return None
    centre = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    if model == "mean":
        return _mean_motion(displacement, speed, centre, outlier_sigmas)
    offset, straight = position - centre, displacement
    if model != "similarity" or (expected is not None and not expected.turns):
        expected = None
    if expected is not None:
        straight = displacement - expected.rotation * np.stack([-offset[:, 1], offset[:, 0]], 1)
    inliers = _mode(straight, sigma)
    if len(position) > 1 and np.count_nonzero(inliers) < 2:
        return None
    motion = _robust_fit(offset, straight, sigma, speed, centre, inliers, model)
    if expected is not None:
        motion = motion.turned_with(expected)
    few = len(position) >= _MANY_VECTORS and motion.star_count < _LEAST_SHARE * len(position)
    return None if few else motion


def vote_shift(
    previous_xy: Array,
    previous_flux: Array,
    current_xy: Array,
    current_flux: Array,
    bin_px: float = 2.0,
) -> Array | None:
    """Shift of the field from positions and brightness alone, however far it moved.

    Every pair of a bright object of the previous frame and one of the current, of similar flux,
    votes for their displacement; true pairs vote alike, wrong ones all over the plane.

    Parameters
    ----------
    previous_xy, current_xy : (N, 2), (M, 2) float64
        Centroids, px.
    previous_flux, current_flux : (N,), (M,) float64
        Fluxes, DN.
    bin_px : float
        Two votes closer than this agree, px.

    Returns
    -------
    (2,) float64 or None
        Displacement, px per frame; None if no displacement has more votes than chance gives.
    """
    if not (previous_flux.size and current_flux.size):
        return None
    a, b = _brightest(previous_flux), _brightest(current_flux)
    before, now = (np.log(np.maximum(flux, 1e-9)) for flux in (previous_flux[a], current_flux[b]))
    alike = np.abs(now - before[:, None]) < np.log(1.5)
    if not alike.any():
        return None
    ends = zip(previous_xy[a].T, current_xy[b].T, strict=True)
    votes = np.stack([(end - start[:, None])[alike] for start, end in ends])
    coarse, chance = _densest(votes, bin_px)
    few = min(a.size, b.size) == 1
    if not few and coarse.shape[1] < max(2.0, chance + 4 * np.sqrt(chance)):
        return None
    return np.median(_densest(coarse, bin_px)[0], axis=1)


def _brightest(flux: Array) -> NDArray[np.intp]:
    return np.argsort(-flux)[:_VOTERS]


def _densest(votes: Array, cell_px: float) -> tuple[Array, float]:
    """Of votes (2, N), those in the densest 3 x 3 cells, and how many such cells hold by chance.

    The cells are larger where votes are far apart, as a field may move by as much as the image is
    wide and the cost of counting is that of the cells: what is found is then sought in once more.
    """
    x, y = votes[0] - votes[0].min(), votes[1] - votes[1].min()
    cell_px = max(cell_px, float(max(x.max(), y.max())) / _VOTE_CELLS)
    x, y = (x / cell_px).astype(np.intp) + 1, (y / cell_px).astype(np.intp) + 1
    columns, rows = x.max() + 2, y.max() + 2
    # Small numbers: fresh memory costs as much time as counting.
    counts = np.zeros((columns, rows), np.uint16)
    np.add.at(counts.ravel(), x * rows + y, np.uint16(1))
    # A peak may lie on a cell's border: count each cell with its neighbours.
    near = cv2.boxFilter(counts, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    best_x, best_y = np.unravel_index(np.argmax(near), near.shape)
    chance = 9 * x.size / max(1, cv2.countNonZero(near))
    return votes[:, (np.abs(x - best_x) <= 1) & (np.abs(y - best_y) <= 1)], chance


def _mean_motion(
    displacement: Array, speed: Array, centre: Array, outlier_sigmas: float
) -> StarFieldMotion:
    """Mean velocity once the outliers of speed are removed, repeatedly until none is left."""
    inliers = np.ones(len(speed), bool)
    for _ in range(20):
        mean, std = speed[inliers].mean(), speed[inliers].std()
        # the tiny slack keeps vectors that are all alike
        kept = np.abs(speed - mean) <= outlier_sigmas * std + 1e-9
        if not kept.any() or np.array_equal(kept, inliers):
            break
        inliers = kept
    shift = displacement[inliers].mean(axis=0)
    residual = displacement[inliers] - shift
    covariance = np.zeros((4, 4))
    covariance[[0, 1], [0, 1]] = residual.var(axis=0) / np.count_nonzero(inliers)
    return StarFieldMotion(
        centre=centre,
        displacement=shift,
        rotation=0.0,
        scale=0.0,
        covariance=covariance,
        inliers=inliers,
        residual_px=float(np.sqrt(np.mean(residual**2))),
        residual_sigmas=1.0,
        speed_mean=float(speed[inliers].mean()),
        speed_std=float(speed[inliers].std()),
        model="mean",
    )


def _mode(displacement: Array, sigma: Array) -> NDArray[np.bool_]:
    """Vectors near the place where most of them are."""
    # Wide enough for a field that rotates a little, narrow enough to tell slow RSOs apart.
    reach = 1.0 + 3 * sigma.mean(axis=1)
    cell_px = 2 * float(np.median(reach)) / 3
    coarse, _ = _densest(displacement.T, cell_px)
    winner = np.median(_densest(coarse, cell_px)[0], axis=1)
    return np.hypot(*(displacement - winner).T) <= reach


def _robust_fit(
    offset: Array,
    displacement: Array,
    sigma: Array,
    speed: Array,
    centre: Array,
    start: NDArray[np.bool_],
    model: str,
) -> StarFieldMotion:
    """Iteratively reweighted least squares with Tukey's biweight."""
    # With offsets in units of the field's size all parameters are px, of like conditioning.
    size = max(1.0, float(np.max(np.abs(offset))))
    design = _design(offset / size).reshape(-1, 4).T.copy()
    measured, known = displacement.ravel(), (1 / sigma**2).ravel()
    weight = np.where(start, 1.0, 0.0)
    values, covariance = np.zeros(4), np.zeros((4, 4))
    for _ in range(15):
        used = _what_to_fit(model, int(np.count_nonzero(weight)))
        rows = design[used]
        weighted = rows * (np.repeat(weight, 2) * known)
        inverse = np.linalg.pinv(weighted @ rows.T, _LEAST_CONDITION)
        before, values = values, np.zeros(4)
        values[used] = inverse @ (weighted @ measured)
        residual = measured - values @ design
        squares = residual * residual * known
        normal = np.sqrt((squares[::2] + squares[1::2]) / 2)
        # Errors larger than stated (blends, a distorted field) widen the scale, never narrow it.
        spread = max(1.0, 1.4826 * float(np.median(normal[weight > 0])) / 1.24)
        weight = np.maximum(1 - (normal / (_TUKEY * spread)) ** 2, 0) ** 2
        if np.max(np.abs(values - before)) < _CONVERGED_PX or not weight.any():
            break
    units = np.array([1, 1, 1 / size, 1 / size])
    covariance[np.ix_(used, used)] = inverse * spread**2
    values, covariance = values * units, covariance * np.outer(units, units)
    inliers = weight > 0
    if not inliers.any():
        inliers = start
    return StarFieldMotion(
        centre=centre,
        displacement=values[:2],
        rotation=float(values[3]),
        scale=float(values[2]),
        covariance=covariance,
        inliers=inliers,
        residual_px=float(np.sqrt(np.mean(residual.reshape(-1, 2)[inliers] ** 2))),
        residual_sigmas=spread,
        speed_mean=float(speed[inliers].mean()),
        speed_std=float(speed[inliers].std()),
        model="shift" if used is _SHIFT else "similarity",
    )


def _what_to_fit(model: str, stars: int) -> list[int]:
    """Which of the four parameters so many stars tell."""
    if model != "similarity" or stars < _STARS_FOR_TURN:
        return _SHIFT
    return _TURN if stars < _STARS_FOR_SIMILARITY else _SIMILARITY


def _log_chance(found: int, of: int, share: float) -> float:
    """Logarithm of the bound on the probability of at least `found` of `of`, each with `share`."""
    if found <= 0 or found <= share * of:
        return 0.0
    part, share = found / of, max(share, 1e-12)
    missing = 0.0 if found == of else (1 - part) * np.log((1 - part) / (1 - share))
    return float(-of * (part * np.log(part / share) + missing))


def _design(offset: Array) -> Array:
    """Rows of the linear model for (shift x, shift y, scale, rotation), (N, 2, 4)."""
    design = np.zeros((len(offset), 2, 4))
    design[:, 0, 0] = design[:, 1, 1] = 1
    design[:, :, 2] = offset
    design[:, 0, 3], design[:, 1, 3] = -offset[:, 1], offset[:, 0]
    return design
