"""Calibration without a phantom, from two crossing sweeps of anything with structure.

Images of each sweep are compared with cuts straight from the other's frames, and the calibration is changed
until the correlation is largest.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging, 2008.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.angulation import Angulation, angulation, point_motion
from calibration.images.errors import (
    LEAST_SIMILARITY,
    covariance_of,
    require_accuracy,
    require_one_answer,
)
from calibration.images.search import DECISION, refine, search
from calibration.images.similarity import CrossingSweeps, Level
from calibration.settings import ImageFit
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import condition_number
from speckle3d.core.progress import Progress
from speckle3d.core.text import shown

FINE = (Level(1.0, images=8), Level(0.7, images=24, overlap=0.25))
"""Resolutions at which the search's answer is refined. The last is still coarser than speckle; there many
images are worth more than overlapping patches, since the errors of their poses are independent."""

SPECKLED_SIMILARITY = 0.45
"""Correlation below which the verdict warns: shadows and reflections that the sweeps do not share
displaced such answers by up to a millimetre and two degrees, more than the covariance says."""


@shown
@dataclass(frozen=True)
class ImageCalibration:
    """Mounting of the image on the sensor from two crossing sweeps, with its errors.

    Attributes
    ----------
    settings : ImageFit
    sensor_from_image : RigidTransform
    covariance : ndarray, shape (6, 6)
        Of the image's pose in its own frame, at its origin: turns about its x, y, z (tilt, yaw, roll) in rad,
        then displacements along them in mm. From how the answer changes when one part of the scanned tissue,
        or one stretch of a sweep, after another is left out, and from what the tracker may displace one sweep
        against the other by. Not of an uncorrected delay of the sensor or a wrong speed of sound.
    condition_number : float
        Of the similarity's curvature with scaled columns, as a root; a large one means that the sweeps
        leave some motion of the image undetermined.
    alike : float
        Correlation of the two sweeps' patches at 1.2 mm of blur, times the root of the share of them with
        support; see `LEAST_SIMILARITY`.
    before, after : float
        Mean correlation of those patches at the start and at the answer; NaN where the sweeps do not overlap.
    angulation : Angulation
        How strongly each error of the answer would show.
    sweeps : CrossingSweeps
        What was compared, with the numbers of the frames.
    """

    settings: ImageFit
    start: RigidTransform
    sensor_from_image: RigidTransform
    pixel_mm: FloatArray
    covariance: FloatArray
    condition_number: float
    alike: float
    before: float
    after: float
    angulation: Angulation
    sweeps: CrossingSweeps = field(repr=False)

    def covariance_of(self, point_mm: FloatArray) -> FloatArray:
        """Covariance of where a point of the image lies, along the image's axes, shape (3, 3), mm^2."""
        motion = point_motion(point_mm[None])[0]
        return np.asarray(motion @ self.covariance @ motion.T)


def calibrate_images(
    crossing: CrossingSweeps,
    start: RigidTransform,
    settings: ImageFit | None = None,
    progress: Progress | None = None,
) -> ImageCalibration:
    """Calibrate the image's mounting on the sensor from two crossing sweeps.

    Parameters
    ----------
    crossing : CrossingSweeps
        Both sweeps, by `prepare`.
    start : RigidTransform
        A guess of sensor from image: a ruler's, or an old calibration.
    progress : callable, optional
        Called with how many of how many steps of a stage are done.

    Raises
    ------
    InsufficientDataError
        If the sweeps do not overlap or have nothing in common, their motion or the tissue leaves the answer
        open, or another answer is as good.
    """
    s = settings or ImageFit()
    answer, rivals = start, list[RigidTransform]()
    if s.capture_mm > 0.0 or s.capture_deg > 0.0:
        reach = float(np.deg2rad(s.capture_deg))
        answer, *rivals = search(crossing, start, s.capture_mm, reach, progress)
    for level in FINE:
        fit = refine(crossing.level(level, answer), answer)
        answer = fit.sensor_from_image
    poses = [stack.world_from_sensor for stack in crossing.stacks]
    comparison = crossing.level(DECISION, answer)
    alike = comparison.at(answer).score
    if alike < LEAST_SIMILARITY:
        result = "no overlap" if alike < 0 else f"{alike:.2f} at best"
        raise InsufficientDataError(
            "expected sweeps that show the same structure, with a correlation of at least "
            f"{LEAST_SIMILARITY:g} over what both cover, got {result}"
        )
    angles = angulation(poses[0], poses[1], answer)
    angles.require()
    if not fit.converged:
        raise InsufficientDataError(
            "expected a fit of the two sweeps that comes to rest, got one that still moves after all its "
            "steps: a better start, or longer sweeps with more structure, would help"
        )
    tracker = s.tracker_mm, float(np.deg2rad(s.tracker_deg))
    covariance, curvature = covariance_of(fit, crossing, tracker)
    require_accuracy(covariance, angles, crossing.centre_mm)
    require_one_answer(comparison, answer, rivals)
    return ImageCalibration(
        settings=s,
        start=start,
        sensor_from_image=answer,
        pixel_mm=crossing.pixel_mm,
        covariance=covariance,
        condition_number=condition_number(np.asarray(np.linalg.cholesky(curvature).T, np.float64)),
        alike=alike,
        before=comparison.at(start).mean,
        after=comparison.at(answer).mean,
        angulation=angles,
        sweeps=crossing,
    )
