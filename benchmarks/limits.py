# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What theory allows: how faint a point source may be to be found, and how well it is placed.

Stands beside `sensitivity`, which measures both.  The noise is white and Gaussian, and so is the
PSF, of standard deviation p.

One frame.  A matched filter's output is a Gaussian field of unit variance; of a PSF of width p it
has the correlation exp(-r^2 / 4p^2), so the second spectral moment k = 1 / 2p^2 along each axis.
It exceeds t at (Adler, "The geometry of random fields", 1981, for two dimensions)

    N(t) = A k (2 pi)^(-3/2) t exp(-t^2 / 2)

places of an area A: the number of independent peaks.  The threshold is the t at which N is the
false alarms allowed per frame, and the probability to find an RSO is P = Phi(SNR - t): nobody who
looks at one frame only does better.

n frames, stacked along every straight path.  The SNR is sqrt(n) times as high, and the stack is a
field over x, y and the velocity, in which second moments are k and k (n^2 - 1) / 12:

    N(t) = V k^2 (n^2 - 1) / 12 (2 pi)^(-5/2) (t^3 - 3 t) exp(-t^2 / 2)

with V = (A / (n - 1))^2 the volume of the places and velocities of paths that stay in the image
(four dimensions): the number of trial velocities is in it.  One false stack gives a false alarm in
each of n frames, so that N is again their number per frame.  Live, n is the frames so far.

Both take the stars as known.  Who learns the sky from the same n frames, pixel by pixel, subtracts
with it the RSO's own mean: of the n SNR^2 of a stack remain, at the speed v against the stars,

    SNR^2 (n - sum_ij exp(-v^2 (i - j)^2 / 4p^2) / n)

which is n - 1 for all that leaves its place, and less for the slow.

The centroid.  With s the light of the pixels and w their noise, the Cramer-Rao bound of x is
w^2 / sum (ds/dx)^2.  A Gaussian has sum (ds/dx)^2 = sum s^2 / 2p^2, and SNR^2 = sum s^2 / w^2, so

    sigma_x = sqrt(2) p / SNR

(p / SNR is the bound if an RSO's own photons are the noise).  A pixel integrates over its
square: p^2 = psf^2 + 1/12.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, norm


def centroid_bound(snr: float, width_px: float) -> float:
    """Return the Cramer-Rao bound of a centroid along one axis, px."""
    return float(np.sqrt(2) * width_px / snr)


def poisson_limit(count: int, confidence: float) -> float:
    """Return the upper limit on the mean of which a count was seen."""
    return float(chi2.ppf(confidence, 2 * (count + 1)) / 2)


def information(frames: int, speed_px: float, width_px: float) -> float:
    """Return SNR^2 of a stack in units of one frame's, the sky learned from the same frames.

    Parameters
    ----------
    frames : int
        Frames in the stack.
    speed_px : float
        Speed against the stars, px per frame.
    width_px : float
        The PSF's standard deviation, px.
    """
    i = np.arange(frames)
    way = speed_px * (i[:, None] - i)
    return float(frames - np.sum(np.exp(-(way**2) / (4 * width_px**2))) / frames)


class MatchedFilter:
    """A matched filter over the stack of frames along every straight path.

    Parameters
    ----------
    side_px : int
        Side of the square image, px.
    width_px : float
        The PSF's standard deviation, px.
    false_alarms : float
        False alarms per frame that are allowed.
    """

    def __init__(self, side_px: int, width_px: float, false_alarms: float) -> None:
        self._area, self._moment = side_px**2, 1 / (2 * width_px**2)
        self._false_alarms = false_alarms

    def exceeding(self, frames: int, t: float) -> float:
        """Return how many places (and velocities) of pure noise exceed t sigmas."""
        k, area, tail = self._moment, self._area, np.exp(-(t**2) / 2)
        if frames == 1:
            return float(area * k * (2 * np.pi) ** -1.5 * t * tail)
        volume = (area / (frames - 1)) ** 2 * k**2 * (frames**2 - 1) / 12
        return float(volume * (2 * np.pi) ** -2.5 * (t**3 - 3 * t) * tail)

    def threshold(self, frames: int) -> float:
        """Return the threshold of a stack, sigmas, that gives the false alarms allowed."""

        def surplus(t: float) -> float:
            return float(np.log(self.exceeding(frames, t) / self._false_alarms))

        return float(brentq(surplus, 3.0, 30.0))

    def probability(
        self, snr: float, frames: Sequence[int], gains: Sequence[float] | None = None
    ) -> float:
        """Return the mean probability to find a source in stacks of these numbers of frames.

        Parameters
        ----------
        snr : float
            In one frame.
        frames : sequence of int
            Numbers of frames of the stacks.
        gains : sequence of float, optional
            SNR^2 of each stack in units of one frame's; default: the number of frames.
        """
        limits = {n: self.threshold(n) for n in set(frames)}
        return float(
            np.mean(
                [
                    norm.cdf(snr * np.sqrt(gain) - limits[n])
                    for n, gain in zip(frames, gains or frames, strict=True)
                ]
            )
        )
