# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Angles and orbits: an orbit comes back out of images of a satellite that flies it.

``python -m benchmarks.orbit`` takes a satellite's published elements and a site, finds a pass by
night, renders what a camera there sees, writes a bag, runs ``ofsat process BAG --tdm kvn``, and
fits an orbit to the angles of the tracking data message.  Two tables tell how far the angles are
off the true directions, beside the std that is stated with them, and the orbit beside the true
one.  The exit code is 1 if a target is missed: an rms of at most 1.5 stated stds, before the fit
and after it, no bias over 0.1 px, and an orbit that is the true one within its covariance.

**Truth.**  SGP4 takes the elements to positions in TEME; one rotation, astropy's for the middle of
the pass, takes these to the axes of GCRS, which are those of ICRS (over a pass the two drift by
0.001").  The site is astropy's, with the tables of the Earth's rotation that it brings along;
nothing is downloaded.  A direction at t leads from the site at t to where the satellite was when
the light left it.  Aberration and refraction are left out, in the rendering and in the fit: the
attitude is the camera's true one.  (Attitudes of a plate solver need a correction of up to 20" for
the stars' annual aberration, which the light of an Earth satellite does not have.)

**Camera.**  1024x1024 px of 8", as a 135 mm lens has on pixels of 5.2 um; two frames a second, in
bursts over the pass.  *Tracking*: exposures of 0.2 s; an alt-azimuth mount follows the prediction,
0.2 s late and with a wander of 0.05 deg, so that stars streak and the field turns.  *Stares*:
0.1 s; in each burst the camera stands still against the stars, and the satellite streaks by 8 px.
Images are stamped at the start of the exposure, and attitudes ten times a second by a clock of
their own: the chain has to find the middle of the exposure and the attitude then.  In stares the
time of the images counts (1 ms is 0.7" at 0.2 deg/s), in tracking that of the attitudes.

**Angles.**  Means and rms are along the satellite's motion and across it.  Outliers, more than 5
stated stds off the median, are counted and left out of them; they may be 5 % at most.

**Fit.**  Least squares of SGP4's mean elements (mean motion, e cos w, e sin w, inclination, node,
and argument of latitude at the pass's middle, which unlike that at the elements' epoch does not
hang on the mean motion) against angles weighted by their stated stds; drag as published.  It
starts from elements that are 0.5 deg off along the orbit and in its plane, and 1 % in the mean
motion.  Angles within 5 stds of the fit count.  The covariance is that of the stated stds.  What
one pass leaves open is above all the range and the size of the orbit: angles see them only through
the curvature of the path and the site's own motion.
"""

from benchmarks.orbit.report import main

__all__ = ["main"]
