"""Drift correction of a sensorless reconstruction by a position or an orientation sensor.

The image-based poses have good fine detail and slow drift; the sensor has no drift and coarse jitter.
Smooth curves, too stiff to follow the jitter, bend the one onto the other.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt
from speckle3d.core.text import shown
from speckle3d.correction.claims import curve_errors, length_sigma
from speckle3d.correction.curves import (
    AXES,
    CUBIC,
    CorrectedChain,
    Curves,
    curve_basis,
)


class DriftSettings(BaseModel):
    """Settings of the drift correction."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    curves: Curves = Field(
        "time",
        description="time: the published cubics in t = f / F. distance: the cubics of z, tilt and yaw "
        "multiply the signed estimated step, so that a correction turns round with the probe.",
    )
    loss_epsilon_mm: float = Field(
        0.01,
        gt=0,
        description="Distance below which the unsquared corner distance is rounded off to be differentiable.",
    )
    minimum_frames: int = Field(10, ge=CUBIC + 2, description="Shortest sweep that is corrected, frames.")
    minimum_coverage: float = Field(
        0.8, ge=0, le=1, description="Least share of the frames that need a sensor reading."
    )
    maximum_end_gap: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Largest share of the frames that may lack a reading at either end, where curves would "
        "extrapolate.",
    )
    minimum_travel_mm: float = Field(
        0.1, gt=0, description="Least sum of |step| for which curves in distance are defined."
    )
    tolerance: float = Field(
        1e-6, gt=0, description="Relative change of cost and coefficients at which the optimisation stops."
    )


@shown
@dataclass(frozen=True)
class DriftCorrection:
    """A corrected reconstruction and how it was corrected.

    Attributes
    ----------
    poses : RigidTransform, length n
        ``world_from_image`` in the sensor's world.
    fit : OptimizeResult
        Of the curves' coefficients, by SciPy.
    names : tuple of str
        Of the coefficients.
    curves : ndarray, shape (n, 6)
        Every frame's correction (x, y, z, tilt, yaw, roll) of the step into it, mm and rad; row 0 is the
        offset at the first frame, after a rigid registration. In `correct_orientation` it acts at the
        image centre.
    coverage : float
        Share of the frames that had a sensor reading and so took part in the cost.
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) about the image's centre, along the first frame's axes, mm and rad: by
        the readings' scatter about the curves, and in `correct_mode` by what is known of the sensor, too.
    length_sigma : float
        Relative standard deviation of the length.
    """

    poses: RigidTransform
    fit: OptimizeResult
    names: tuple[str, ...]
    curves: FloatArray
    coverage: float
    settings: DriftSettings
    covariance: FloatArray
    length_sigma: float


def correct_pose(
    world_from_image: RigidTransform,
    reference: RigidTransform,
    has_reading: BoolArray,
    corners_mm: FloatArray,
    settings: DriftSettings | None = None,
) -> DriftCorrection:
    """Correct all six degrees of freedom by a position sensor (Housden et al. 2008, equations 1 to 4).

    The sweep is first registered rigidly to the sensor's world, so that the six first-frame offsets start
    near zero, far from the singularity of their angles; they remain free, so the corrected sequences that
    can be reached are the published ones. The cost is the sum of unsquared distances between
    corresponding image corners, given to Levenberg-Marquardt as vectors e / (|e|^2 + epsilon^2)^(1/4).

    Parameters
    ----------
    world_from_image : RigidTransform, length n
        Image-based poses, in any world, mm.
    reference : RigidTransform, one for each frame with a reading
        The sensor's ``world_from_image`` of each of them.
    has_reading : ndarray of bool, shape (n,)
        Frames with a reading. The others are corrected by the same smooth curves and add no cost.
    corners_mm : ndarray, shape (4, 3)
        Image corners in the image frame.

    Raises
    ------
    InsufficientDataError
        If the sweep is too short, its coverage too small, or "distance" curves lack travel.

    References
    ----------
    .. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its
       use in a hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008.
    """
    settings = settings or DriftSettings()
    _require_coverage(has_reading, settings)
    centre = corners_mm.mean(axis=0)
    sensor_from_start = _mean_alignment(world_from_image[has_reading], reference, centre)
    target = _points(sensor_from_start.inv() * reference, corners_mm)
    chain = _chain(world_from_image, centre, AXES, settings)

    def misfit(poses: FloatArray) -> FloatArray:
        """Equation (4): distances between corrected and measured corners of every frame with a reading."""
        error = _points(RigidTransform.from_matrix(poses), corners_mm) - target
        square = (error**2).sum(axis=-1, keepdims=True) + settings.loss_epsilon_mm**2
        return np.asarray((error * square**-0.25).reshape(len(poses), -1))

    fit = _solve(misfit, chain, has_reading, settings)
    poses = sensor_from_start * RigidTransform.from_matrix(chain.poses(fit.x))
    left = poses[has_reading].inv() * reference
    error = np.hstack([left.apply(centre) - centre, left.rotation.as_rotvec()])
    return _correction(poses, fit, chain, has_reading, settings, error, centre)


def correct_orientation(
    world_from_image: RigidTransform,
    reference: Rotation,
    has_reading: BoolArray,
    centre_mm: FloatArray,
    settings: DriftSettings | None = None,
) -> DriftCorrection:
    """Correct orientation by an orientation sensor (Housden et al. 2008, equation 5).

    Every correction turns a frame about its image centre, which therefore keeps its place relative to the
    frame before: elevational length is unchanged by construction. The result is in the orientation
    sensor's world; its origin, which such a sensor does not know, is put at the first frame's image origin.

    Parameters
    ----------
    world_from_image, has_reading, settings
        As for `correct_pose`.
    reference : Rotation, one for each frame with a reading
        The sensor's ``world_from_image`` of each of them.
    centre_mm : ndarray, shape (3,)
        Image centre in the image frame.

    Raises
    ------
    InsufficientDataError
        As for `correct_pose`.

    References
    ----------
    .. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its
       use in a hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008.
    """
    settings = settings or DriftSettings()
    _require_coverage(has_reading, settings)
    sensor_from_start = (reference * world_from_image[has_reading].rotation.inv()).mean()
    target = sensor_from_start.inv() * reference
    # With the frame's origin moved to the centre, a turn about the centre has no translation.
    image_from_centre = RigidTransform.from_translation(centre_mm)
    chain = _chain(world_from_image * image_from_centre, np.zeros(3), AXES[3:], settings)

    def misfit(poses: FloatArray) -> FloatArray:
        """Equation (5): roll, yaw and tilt of the measured orientation seen from the corrected frame."""
        return roll_yaw_tilt(Rotation.from_matrix(poses[:, :3, :3]).inv() * target)

    fit = _solve(misfit, chain, has_reading, settings)
    about_centre = RigidTransform.from_matrix(chain.poses(fit.x))
    in_sensor = RigidTransform.from_rotation(sensor_from_start) * about_centre * image_from_centre.inv()
    poses = RigidTransform.from_translation(-in_sensor[0].translation) * in_sensor
    angles = fit.fun.reshape(-1, 3)[:, ::-1]
    error = np.hstack([np.zeros_like(angles), angles])
    return _correction(poses, fit, chain, has_reading, settings, error, centre_mm)


def _solve(
    misfit: Callable[[FloatArray], FloatArray],
    chain: CorrectedChain,
    has_reading: BoolArray,
    settings: DriftSettings,
) -> OptimizeResult:
    """Least squares of the misfits of poses that have a reading, each of which depends on one pose alone."""
    tick = 1e-7
    small = RigidTransform.from_exp_coords(tick * np.eye(6)).as_matrix()

    def jacobian(coefficients: FloatArray) -> FloatArray:
        poses = chain.poses(coefficients)
        twists = np.concatenate(chain.twists(coefficients, poses), axis=1)[has_reading]
        error = misfit(poses[has_reading])
        slopes = np.stack([misfit(nudge @ poses[has_reading]) - error for nudge in small], axis=-1) / tick
        return np.asarray((slopes @ twists).reshape(-1, coefficients.size))

    def residuals(coefficients: FloatArray) -> FloatArray:
        return misfit(chain.poses(coefficients)[has_reading]).ravel()

    tolerance = settings.tolerance
    return least_squares(
        residuals,
        np.zeros(len(chain.names)),
        jacobian,
        method="lm",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
    )


def _correction(
    poses: RigidTransform,
    fit: OptimizeResult,
    chain: CorrectedChain,
    has_reading: BoolArray,
    settings: DriftSettings,
    error: FloatArray,
    centre_mm: FloatArray,
) -> DriftCorrection:
    """The result, with what the readings' scatter about the curves claims."""
    covariance = curve_errors(error, has_reading)
    sigma, values = length_sigma(poses, covariance, centre_mm), chain.values(fit.x)
    return DriftCorrection(
        poses, fit, chain.names, values, float(has_reading.mean()), settings, covariance, sigma
    )


def _chain(
    poses: RigidTransform, centre: FloatArray, axes: tuple[str, ...], settings: DriftSettings
) -> CorrectedChain:
    steps_mm = elevational_steps(poses, centre)
    travel_mm = float(np.abs(steps_mm).sum())
    if settings.curves == "distance" and travel_mm < settings.minimum_travel_mm:
        raise InsufficientDataError(
            f"expected at least {settings.minimum_travel_mm:g} mm of elevational travel for curves of "
            f"'distance', got {travel_mm:.3g} mm; curves of 'time' need none"
        )
    return CorrectedChain.of(poses, axes, curve_basis(axes, steps_mm, settings.curves))


def _points(poses: RigidTransform, corners: FloatArray) -> FloatArray:
    """Corners in the world, shape (f, c, 3)."""
    translation, rotation = poses.as_components()
    return np.asarray(corners @ rotation.as_matrix().transpose(0, 2, 1) + translation[:, None, :])


def _mean_alignment(moving: RigidTransform, fixed: RigidTransform, centre_mm: FloatArray) -> RigidTransform:
    """Rigid transform ``fixed_from_moving`` of the mean turn and the mean place of the image's centre."""
    turn = (fixed.rotation * moving.rotation.inv()).mean()
    shift = (fixed.apply(centre_mm) - turn.apply(moving.apply(centre_mm))).mean(axis=0)
    return RigidTransform.from_components(shift, turn)


def _require_coverage(has_reading: BoolArray, settings: DriftSettings) -> None:
    """Raise `InsufficientDataError` unless readings determine the curves everywhere."""
    frames, count = has_reading.size, int(has_reading.sum())
    if frames < settings.minimum_frames:
        raise InsufficientDataError(
            f"drift correction: expected {settings.minimum_frames} frames or more, got {frames}"
        )
    least = max(settings.minimum_coverage * frames, settings.minimum_frames)
    end = int(settings.maximum_end_gap * frames) + 1
    if count < least or not (has_reading[:end].any() and has_reading[-end:].any()):
        raise InsufficientDataError(
            f"drift correction: expected sensor readings for at least {least:.0f} of {frames} frames, also "
            f"among the first {end} and the last {end}, got {count}"
        )
