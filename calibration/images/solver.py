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
    RESTARTED,
    claimed,
    curvature_at,
    curvature_of,
    require_known,
    require_one_answer,
)
from calibration.images.fit import refine, settle
from calibration.images.search import DECIDED, search
from calibration.images.similarity import Comparison, CrossingSweeps, Estimate, Level, Progress, prepare
from calibration.images.stacks import TrackedImages
from calibration.settings import ImageFit
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.leastsquares import condition_number
from speckle3d.core.shown import shown

FINE = (Level(1.0, images=8), Level(0.7, images=24, overlap=0.25))
"""Resolutions at which the search's answer is refined. The last is still coarser than speckle; there many
images are worth more than overlapping patches, since the errors of their poses are independent."""

SHOWN_SIGMA_MM = 1.0
"""Blur at which similarities are reported, in units of the crossing."""

SPECKLED_SIMILARITY = 0.45
"""Correlation below which the verdict warns: shadows and reflections that the sweeps do not share
displaced such answers by up to a millimetre and two degrees, more than the covariance says."""


@dataclass(frozen=True)
class Improvement:
    """Mean correlation of images with cuts of the other sweep, at the start and at the answer.

    NaN where the sweeps overlap in no image by three tenths.
    """

    before: float
    after: float


@shown
@dataclass(frozen=True)
class ImageCalibration:
    """Where the image is on the sensor, found from two crossing sweeps.

    Attributes
    ----------
    settings : ImageFit
    sensor_from_image : RigidTransform
    scales, scale_errors : ndarray, shape (2,)
        Factors on the pixel sizes across and along the beams, and their standard errors; one and zero
        where they were not estimated.
    covariance : ndarray, shape (6, 6)
        Of the image's pose in its own frame, at its origin: turns about its x, y, z (tilt, yaw, roll) in rad,
        then displacements along them in mm. From how the answer changes when one part of the scanned tissue,
        or one stretch of a sweep, after another is left out, from what the tracker may displace one sweep
        against the other by, and from the scatter of fits that start beside the answer. It does not know of
        an uncorrected delay of the sensor or a wrong speed of sound.
    condition_number : float
        Of the similarity's curvature with scaled columns, as a root; a large one means that the sweeps
        leave some motion of the image undetermined.
    alike : float
        Correlation of the two sweeps' patches at 1.2 mm of blur, times the root of the share of them with
        support; see `LEAST_SIMILARITY`.
    similarity, held_out : Improvement
        Of images that were compared, and of frames that were left out of everything.
    evaluations : int
        How many times the sweeps were compared.
    sweeps : CrossingSweeps
        What was compared, with the numbers of the frames used and held out.
    """

    settings: ImageFit
    start: RigidTransform
    sensor_from_image: RigidTransform
    scales: FloatArray
    scale_errors: FloatArray
    pixel_mm: FloatArray
    covariance: FloatArray
    condition_number: float
    alike: float
    similarity: Improvement
    held_out: Improvement
    evaluations: int
    converged: bool
    sweeps: CrossingSweeps = field(repr=False)

    def covariance_of(self, point_mm: FloatArray) -> FloatArray:
        """Covariance of where a point of the image lies, along the image's axes, shape (3, 3), mm^2."""
        moved = point_motion(np.asarray(point_mm, dtype=float)[None])[0]
        return np.asarray(moved @ self.covariance @ moved.T)


def calibrate_images(
    first: TrackedImages,
    second: TrackedImages,
    start: RigidTransform,
    settings: ImageFit | None = None,
    progress: Progress | None = None,
) -> ImageCalibration:
    """Find where the image is on the sensor from two crossing sweeps.

    Parameters
    ----------
    start : RigidTransform
        A guess of sensor from image: a ruler's, or an old calibration.
    progress : callable, optional
        Called with the stage, and how many of how many of its steps are done.

    Raises
    ------
    InvalidInputError, MismatchError
        If the images, grids and start are not what they must be.
    InsufficientDataError
        If there are too few frames, the sweeps do not overlap or have nothing in common, their motion or the
        tissue leaves the answer open, or another answer is as good.
    """
    return calibrate_from_sweeps(prepare(first, second, progress), start, settings, progress)


def calibrate_from_sweeps(
    crossing: CrossingSweeps,
    start: RigidTransform,
    settings: ImageFit | None = None,
    progress: Progress | None = None,
) -> ImageCalibration:
    """Calibrate as `calibrate_images`, from sweeps that are prepared already: for many starts."""
    if not start.single:
        raise InvalidInputError("start: expected a single transform, got a row of them")
    chosen = settings or ImageFit()
    first = found = Estimate(start, np.ones(2))
    free, looks, rivals = tuple(range(8 if chosen.scales else 6)), 0, list[Estimate]()
    if chosen.capture_mm > 0.0 or chosen.capture_deg > 0.0:
        reach = float(np.deg2rad(chosen.capture_deg))
        (found, *rivals), looks = search(crossing, first, chosen.capture_mm, reach, progress)
    for number, level in enumerate(FINE):
        refined = refine(crossing.level(level, found.sensor_from_image), found, free, share=True)
        found, looks = refined.estimate, looks + refined.evaluations
        if progress:
            progress("refining", number + 1, len(FINE))
    alike = _require_alike(crossing, found)
    angles = _angulation(crossing, found.sensor_from_image)
    angles.require()
    bends, curvature = curvature_of(refined, angles, crossing.unit, share=True)
    refined = settle(refined, curvature_at(refined, share=True), share=True)
    found, near = refined.estimate, refined.estimate.sensor_from_image
    tracker = chosen.tracker_mm, float(np.deg2rad(chosen.tracker_deg))
    restarted = crossing.level(RESTARTED, near)
    covariance = claimed(refined, bends, curvature, restarted, crossing.unit, tracker, share=True)
    if not chosen.scales:  # which takes the place of a displacement along the beams; the verdict says so
        require_known(covariance, angles, crossing.centre_mm)
    require_one_answer(crossing.level(DECIDED, near), found, rivals, crossing.centre_mm, share=True)
    return ImageCalibration(
        settings=chosen,
        start=start,
        sensor_from_image=near,
        scales=found.scales,
        scale_errors=np.sqrt(np.diag(covariance)[6:8]),
        pixel_mm=crossing.pixel_mm * found.scales,
        covariance=covariance[:6, :6],
        condition_number=condition_number(np.asarray(np.linalg.cholesky(curvature).T, np.float64)),
        alike=alike,
        similarity=_improvement(crossing.whole(SHOWN_SIGMA_MM, near, 10), first, found),
        held_out=_improvement(crossing.whole(SHOWN_SIGMA_MM, near), first, found),
        evaluations=looks,
        converged=refined.converged,
        sweeps=crossing,
    )


def _angulation(crossing: CrossingSweeps, sensor_from_image: RigidTransform) -> Angulation:
    first, second = crossing.used
    poses = first.world_from_sensor, second.world_from_sensor
    return angulation(*poses, sensor_from_image, first.corners_mm)


def _require_alike(crossing: CrossingSweeps, found: Estimate) -> float:
    """Score of the sweeps at an answer, with speckle blurred away; refuse one below `LEAST_SIMILARITY`."""
    seen = crossing.level(DECIDED, found.sensor_from_image)
    score = seen.at(found, share=True).score
    if score < LEAST_SIMILARITY:
        got = "no overlap" if score < 0 else f"{score:.2f} at best"
        raise InsufficientDataError(
            "expected sweeps that show the same structure, with a correlation of at least "
            f"{LEAST_SIMILARITY:g} over what both cover, got {got}"
        )
    return score


def _improvement(comparison: Comparison, first: Estimate, found: Estimate) -> Improvement:
    return Improvement(comparison.at(first).mean, comparison.at(found).mean)
