# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Detect satellites and debris in a telescope camera's stream by their optical flow.

Data flows one way; each stage is a module, and a symptom belongs to the stage it names::

    image -> preprocessing -> objects -> optical_flow -> star_field -> detection -> results

``pipeline.Pipeline`` runs the stages in this order, live (``nodes/``) and offline (``cli``).
Nothing outside ``nodes/`` imports ROS.

Conventions, everywhere in the package:

- Pixels: the centre of the top-left pixel is (0, 0), x to the right (columns), y down (rows),
  float64.  Images are indexed ``image[y, x]``.
- Displacement and velocity: current minus previous; px, and px/s with the time between the
  frames' stamps, never from a nominal rate.
- ``rel_*`` is relative to the star field; without it, relative to the sensor.
- Angles in rad; in files in deg, and the column's name says so.
- Times are int nanoseconds UTC, of the middle of the exposure.
- Unknown is NaN, never 0.
- SNR is the matched filter's: flux over the noise of the flux.
"""

__version__ = "0.1.0"
