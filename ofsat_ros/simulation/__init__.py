# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Frames of a simulated telescope camera, with the truth of what is in them.

It stands at the start of the flow, in the place of a camera, and knows no other stage: tests,
benchmarks, ``ofsat simulate`` and the simulator node feed its frames to the pipeline.

There are two skies.  That of `SkySimulator` is a plane, in arcsec.  Stars fill it without end, at
random; the camera drifts over it at an angular rate, which may be changed between frames, and the
field may turn about the image's centre.  All rates are against the stars: a star's rate is 0, and
what moves at the camera's rate stands still in the image.  In the image, at field angle a and
rotation w about the centre c::

    p = c + R(a) (sky - pointing) / pixel scale
    v = w J (p - c) + (R(a) object rate - camera rate) / pixel scale

with R(a) turning the x axis towards the y axis and J = R(90 deg).  The object's rate is in the
axes of the sky, which are the image's at the start; the camera's in those of the image now.

That of `SphereSimulator` is the celestial sphere.  A `Motion` says how the camera turns, among
them a `SimulatedMount` that obeys commands; a `Target` is an RSO by its direction in time.  With
the attitude A, ICRS -> optical frame, a direction d appears at the pixel of A d in the camera.

A frame is made in this order: light of the stars and RSOs (`rendering`); clouds and the sky's own
light (`sky`); vignetting, gains of the pixels, dark signal, photon noise, offsets, sensor noise,
cosmic rays, quantisation (`sensor`).  Fluxes and noise are set in percent of full scale, so that
a scenario looks the same at every bit depth.  Same settings, same bytes: whatever is random
derives from the seed and from the sky's tile or the frame's number, never from what was rendered
before.  A mount's commands are part of what is to be the same.
"""

from ofsat_ros.simulation.exposure import Simulator, looking_at
from ofsat_ros.simulation.frames import STAR_DTYPE, TRUTH_DTYPE, SimulatedFrame, write_truth
from ofsat_ros.simulation.mount import Fixed, Motion, SimulatedMount
from ofsat_ros.simulation.plane import SkySimulator
from ofsat_ros.simulation.scenarios import SCENARIOS, scenario
from ofsat_ros.simulation.settings import RSO, SimulatorSettings
from ofsat_ros.simulation.sphere import SphereSimulator, Target

__all__ = [
    "RSO",
    "SCENARIOS",
    "STAR_DTYPE",
    "TRUTH_DTYPE",
    "Fixed",
    "Motion",
    "SimulatedFrame",
    "SimulatedMount",
    "Simulator",
    "SimulatorSettings",
    "SkySimulator",
    "SphereSimulator",
    "Target",
    "looking_at",
    "scenario",
    "write_truth",
]
