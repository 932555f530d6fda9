"""Which of a sweep's sensors may be used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.sweep import Sweep
from speckle3d.correction.trust import believed, cleaned_readings, examine_sensors, without_sensors


@dataclass(frozen=True)
class ExaminedSensors:
    """What may be used of a sweep's sensors.

    Attributes
    ----------
    trusted : Sweep
        Without the sensors that are refuted.
    telling : Sweep
        Without those, too, whose motion is not the images': they tell no sign.
    turn_confirmed : bool
        Whether roll or a gyroscope confirm how the orientation sensor turns.
    """

    trusted: Sweep
    telling: Sweep
    turn_confirmed: bool
    doubts: tuple[Doubt, ...]


def examined_sensors(
    sweep: Sweep, image: RigidTransform, covariance: FloatArray, config: Config
) -> ExaminedSensors:
    """Hold a sweep's sensors against its image-based poses, unless the configuration says not to."""
    if not config.sensors.examine:
        return ExaminedSensors(sweep, sweep, True, ())
    cleaned, doubts = cleaned_readings(sweep)
    left = believed(cleaned, doubts)
    z_mm = image.apply(sweep.grid.centre_mm)[:, 2]
    farthest = int(np.argmax(np.abs(z_mm)))
    sigma = float(np.sqrt(covariance[farthest, 2, 2])) / max(abs(float(z_mm[farthest])), 1e-9)
    trust = examine_sensors(left, image, sigma)
    trusted = believed(left, trust.doubts)
    telling = without_sensors(trusted, trust.misled)
    return ExaminedSensors(trusted, telling, trust.turn_confirmed, (*doubts, *trust.doubts))
