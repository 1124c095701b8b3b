# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""Pixels to directions and back: lines of sight, right ascension and declination, and errors.

Stands beside the stages: the detector node and ``ofsat process`` ask it where the things are that
the pipeline has found in pixels.  `Camera` is one calibration, `Attitudes` where it looked when,
`Astrometry` the two together.

The angles are in the attitude's frame: the ICRS if it was found from catalogue places of stars.
They are then topocentric and astrometric: places among the stars as the catalogue has them.  No
correction is applied to them.  What that means for an object near the Earth:

- Annual aberration shifts the stars by up to 20.5", and an object that goes with the Earth not at
  all, in a geocentric frame (GCRS, TEME).  By naming the catalogue place of the star beside it,
  the angles lack a shift that the object never had: its direction in a geocentric frame is the
  stated one plus the aberration of a star there.  Orbit determination has to add it; in a CCSDS
  TDM it is CORRECTION_ABERRATION_YEARLY, not applied.
- Diurnal aberration (0.3" by the Earth's rotation, 5" in orbit) and refraction shift the stars
  and the object alike: they cancel as far as the attitude was found from stars in the same image.
  What is left of refraction, as the object is not infinitely far away, is 0.5" tan z sec z at
  1000 km, z the zenith distance.
- Light time (up to 5" in low orbits) and parallax are left to the orbit determination: stamps are
  those of the light's arrival, directions those from the camera.
- Where an attitude is used far from the stars that gave it, shifts differ: aberration by up to
  0.4" per degree, refraction by about 1" sec^2 z per degree.
- An attitude from a mount's encoders has in it what the mount's pointing model has; usually
  none of all this is then removed.
"""

from ofsat_ros.camera.astrometry import Astrometry, Attitudes, rotation_of
from ofsat_ros.camera.model import Camera, CameraError, from_radec, to_radec

__all__ = [
    "Astrometry",
    "Attitudes",
    "Camera",
    "CameraError",
    "from_radec",
    "rotation_of",
    "to_radec",
]
