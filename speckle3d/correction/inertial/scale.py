"""Length by inertial readings: the images' poses, their scale set by an accelerometer and a gyroscope.

Accelerometer and gyroscope say in metres per second squared how the probe moves at the frequencies of a
hand's tremor or wobble; image steps say the same in the curves' millimetres. Their ratio is the scale.

No data can check one assumption: that the tissue stays where it is while the probe moves. Tissue that follows
the probe by 5 % makes the length 5 % wrong, and everything fits as well as before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import relative_poses
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor
from speckle3d.correction.inertial.problem import (
    GLOBALS,
    ImageSteps,
    InertialProblem,
    Prior,
    Readings,
    Solution,
)
from speckle3d.correction.inertial.readings import gravity_error, inertial_readings
from speckle3d.correction.inertial.settings import ASSUMPTION, InertialSettings
from speckle3d.correction.inertial.signs import SettledSigns, settled_signs
from speckle3d.correction.scale import ScaledPoses, ScaleEvidence

_REMEDY = "wobble the probe by half a millimetre, two or three times a second"
_FEWEST_FRAMES = 30
_STEP_MM, _STEP_SHARE = 0.005, 0.02
"""Error of an image step: a constant and a share of it, in proportion; their size is found from the data."""
_EXPECTED_COUNT = 20.0
"""How many independent steps the error expected of them counts for against what is left of them."""
_CLOCK_RANGE = 2.0
"""Clock offsets are tried up to so many times their standard deviation."""
_CERTAIN = 25.0
"""Squared deviations by which the accelerometer's sign must be the better one: five sigma."""
_LEAST_ALIKE = 0.3
"""Share of the path over which accelerometer and images must go the same way, at least."""
_SIGN_ROUNDS, _NOISE_ROUNDS = 3, 4
_BLIND_MM = 1e3
"""Deviation of image steps that say nothing."""
_MISFIT = 0.7, 1.4
"""Range of chi^2. Noise is measured on some 200 frequencies that no hand reaches, so that chi^2 itself varies
by a tenth where all is well; 0.9 to 1.1 were seen."""
_MOST_STEP_ERROR = 8.0
"""Image steps may be so many times worse than simulated ones (0.3 to 2.2 of them) before they and the sensor
cannot have moved together."""
_CLOCK_SETTLED_S = 0.003
"""A clock that is 5 ms off makes the length 5 % wrong."""
_CLOCK_LIMIT = 2.5
_CURVES_SIGMA = 0.1
"""What curves of another lens or phantom do to the images' scale: 2 to 13 % were measured."""
_WANDERING_MM = 0.02**2 * 2.0
"""Least variance of the length per mm, mm: a scale that changes by 2 % with the tissue, in 2 mm."""
_CORRELATED_S = 0.4
"""Errors of image steps are correlated no longer than this: speckle is shared by frames that are near."""


def correct_inertial(
    image: RigidTransform,
    covariance: FloatArray,
    scale_sigma: float,
    sensor: OrientationSensor,
    frame_time_s: FloatArray,
    centre_mm: FloatArray,
    settings: InertialSettings | None = None,
) -> ScaledPoses:
    """Set the length of image-based poses by an accelerometer and a gyroscope on the probe.

    Orientation is the sensor's, as in mode `orientation`; in-plane motion is the images'.

    Parameters
    ----------
    image : RigidTransform, length n
        Poses of mode `image`, their sign settled.
    covariance : ndarray, shape (n, 6, 6)
        Of `image`; see `speckle3d.motion.uncertainty`.
    scale_sigma : float
        Relative standard deviation of the images' scale, what the curves' mismatch can do included.
    sensor : OrientationSensor
        Calibrated to the image, with accelerometer and gyroscope.
    frame_time_s : ndarray, shape (n,)
    centre_mm : ndarray, shape (3,)
        The image's centre.
    settings : InertialSettings, optional

    Returns
    -------
    ScaledPoses
        In the sensor's world, its origin at the first image's. The evidence has no word on tilt and yaw.

    Raises
    ------
    InsufficientDataError
        If raw readings are missing, too few or saturated, or the motion is too weak to tell the length.
    MismatchError
        If accelerometer, gyroscope and images contradict each other.

    Notes
    -----
    The tissue is assumed to stay where it is: if it follows the probe by 5 %, the length is 5 % wrong, which
    no residual shows.
    """
    s = settings or InertialSettings()
    time_s, centre = np.asarray(frame_time_s, dtype=float), np.asarray(centre_mm, dtype=float)
    _require_shapes(image, covariance, time_s, centre)
    readings = inertial_readings(sensor, time_s)
    # An accelerometer that feels gravity off by a share may feel everything off by it, or have a bias.
    assert sensor.accelerometer_m_s2 is not None
    own = float(np.hypot(s.accelerometer_scale_sigma, gravity_error(sensor.accelerometer_m_s2)))
    s = s.model_copy(update={"accelerometer_scale_sigma": own})
    steps = (relative_poses(image).apply(centre) - centre)[:, 2]
    signs, problem, found = _settled(readings, time_s, steps, s)
    misfit = problem.sensor_misfit(found)
    sigma = _scale_error(problem, found, s) * float(np.sqrt(max(misfit, 1.0)))
    _require_fit(problem, found, misfit)
    _require_told(found, sigma, scale_sigma, s)
    log_scale = float(found.values[0])
    moved = np.where(signs.turned, -1.0, 1.0)
    poses = _poses(image, sensor, time_s, centre, found, moved)
    evidence = ScaleEvidence("inertial", np.array([log_scale, 0.0, 0.0]), np.diag([sigma**-2, 0.0, 0.0]))
    return ScaledPoses(
        poses,
        _covariance(poses, covariance, centre, scale_sigma, sigma, time_s, s),
        log_scale,
        sigma,
        (evidence,),
        _details(found, sigma, misfit, signs, problem, s),
    )


def _require_shapes(
    image: RigidTransform, covariance: FloatArray, time_s: FloatArray, centre: FloatArray
) -> None:
    n = len(image)
    for got, wanted, name in (
        (time_s.shape, (n,), "frame_time_s"),
        (np.shape(covariance), (n, 6, 6), "covariance"),
        (centre.shape, (3,), "centre_mm"),
    ):
        if got != wanted:
            raise InvalidInputError(f"inertial scale: {name}: expected shape {wanted}, got {got}")
    if n < _FEWEST_FRAMES:
        raise InsufficientDataError(
            f"inertial scale: expected at least {_FEWEST_FRAMES} frames, got {n}; record for some seconds"
        )


def expected_error(
    steps_mm: FloatArray, constant_mm: float = _STEP_MM, share: float = _STEP_SHARE
) -> FloatArray:
    """Standard deviation of image steps, a constant and a share of each."""
    return np.hypot(constant_mm, share * steps_mm)


def prior_of(s: InertialSettings) -> Prior:
    """Means and deviations of `GLOBALS`; those of the scale tell nothing."""
    bias = float(np.deg2rad(s.gyroscope_bias_deg_s))
    mean = np.array([0.0, 0.0, 0.0, *s.lever_mm, 0.0, 0.0, 0.0, 0.0])
    sigma = [10.0, 0.2, s.clock_sigma_s, *s.lever_sigma_mm, s.accelerometer_bias_m_s2, bias, bias, 1e-3]
    return Prior(mean, np.array(sigma))


def knot_hz(read_s: FloatArray, s: InertialSettings) -> float:
    """Knots a second: fewer than readings, or there would be nothing to check them by."""
    return min(s.knot_hz, 0.6 / float(np.median(np.diff(read_s))))


def _settled(
    readings: Readings, time_s: FloatArray, steps: FloatArray, s: InertialSettings
) -> tuple[SettledSigns, InertialProblem, Solution]:
    """Signs of the steps, and the answer with them: in turn, because lever arm and signs need each other."""
    blind = ImageSteps(time_s, steps, np.full(steps.size, _BLIND_MM))
    clock_range = 3.0 * _CLOCK_RANGE * s.clock_sigma_s
    problem = InertialProblem(readings, blind, prior_of(s), knot_hz(readings.time_s, s), clock_range)
    signs = _signs(problem, None, s)
    found: Solution | None = None
    for _ in range(_SIGN_ROUNDS):
        right = ImageSteps(time_s, np.where(signs.turned, -steps, steps), expected_error(steps))
        seeing, found = _solved(problem.told(right), signs, found)
        again = _signs(problem.told(blind, _known(problem.prior, found)), found, s)
        if (again.turned == signs.turned).all():
            break
        signs = again
    assert found is not None
    return signs, seeing, found


def _known(prior: Prior, found: Solution) -> Prior:
    """What is known of sensor and lever arm after a first answer."""
    values, sigma = found.values.copy(), np.sqrt(np.diag(found.covariance))
    # Clock and scale are tried anew.
    values[:3], sigma[:3] = prior.mean[:3], prior.sigma[:3]
    return Prior(values, np.minimum(sigma, prior.sigma))


def _signs(blind: InertialProblem, nearby: Solution | None, s: InertialSettings) -> SettledSigns:
    """Signs of the steps by the accelerometer, as far as it is certain of them.

    Parameters
    ----------
    blind : InertialProblem
        In which steps say nothing.
    nearby : Solution, optional

    Raises
    ------
    MismatchError
        If it is certain, and they are not the images'.
    """
    steps, alone = blind.steps.steps_mm, blind.solve(nearby, rounds=2)
    signs = settled_signs(
        lambda time_s: blind.position(alone, time_s),
        blind.steps.time_s,
        steps,
        _CLOCK_RANGE * s.clock_sigma_s,
    )
    if signs.certainty < _CERTAIN:
        return replace(signs, turned=np.zeros(steps.size, dtype=bool), clock_s=0.0, log_scale=0.0)
    share = float(np.abs(steps[signs.turned]).sum() / np.abs(steps).sum())
    if share > 1.0 - _LEAST_ALIKE:
        raise MismatchError(
            f"inertial scale: expected the probe to move as the images go, got an accelerometer that has it "
            f"the other way for {share:.0%} of the path; check sensors.direction, its clock and mounting"
        )
    return signs


def _solved(
    problem: InertialProblem, signs: SettledSigns, nearby: Solution | None
) -> tuple[InertialProblem, Solution]:
    """Solve, and again with the error of the image steps that is left of them."""
    if nearby is None:
        start = problem.prior.mean.copy()
        start[0], start[2] = signs.log_scale, signs.clock_s
        found = problem.solve(start)
    else:
        found = problem.solve(nearby)
    ratio = 1.0
    for _ in range(_NOISE_ROUNDS):
        free = np.maximum(1.0 - found.leverage, 0.05)
        left, count = ratio * robust_sigma(found.image_residuals / np.sqrt(free)), float(free.sum())
        # Where the fit follows nearly every step, what is left of them tells little.
        new = float(np.sqrt((_EXPECTED_COUNT + count * left**2) / (_EXPECTED_COUNT + count)))
        problem = problem.told(replace(problem.steps, sigma_mm=problem.steps.sigma_mm * (new / ratio)))
        found = problem.solve(found)
        if abs(np.log(new / ratio)) < 0.05:
            break
        ratio = new
    return problem, found


def _scale_error(problem: InertialProblem, found: Solution, s: InertialSettings) -> float:
    """Standard deviation of log scale, errors of image steps that are correlated included."""
    variance = float(found.covariance[0, 0])
    white = float(np.sum(found.influence**2))
    pull = found.influence * found.image_residuals / np.sqrt(np.maximum(1.0 - found.leverage, 0.05))
    pause = float(np.median(np.diff(problem.steps.time_s)))
    lags = max(1, round(_CORRELATED_S / pause))
    correlated = float(pull @ pull) + 2.0 * sum(
        (1.0 - lag / (lags + 1.0)) * float(pull[lag:] @ pull[:-lag]) for lag in range(1, lags + 1)
    )
    return float(np.sqrt(variance - white + max(white, correlated) + s.accelerometer_scale_sigma**2))


def _require_fit(problem: InertialProblem, found: Solution, misfit: float) -> None:
    if not _MISFIT[0] < misfit < _MISFIT[1]:
        raise MismatchError(
            f"inertial scale: expected readings that agree with each other (chi^2 of {_MISFIT[0]:g} to "
            f"{_MISFIT[1]:g}), got {misfit:.3g}; is the sensor fixed to the probe and its mounting right?"
        )
    ratio = float(np.median(problem.steps.sigma_mm / expected_error(problem.steps.steps_mm)))
    if ratio > _MOST_STEP_ERROR:
        raise MismatchError(
            f"inertial scale: expected image steps that follow the felt motion to {_STEP_MM:g} mm and "
            f"{_STEP_SHARE:.0%}, got {ratio:.0f} times that; is the sensor fixed to the probe?"
        )
    clock, error = float(found.values[2]), float(np.sqrt(found.covariance[2, 2]))
    if error > _CLOCK_SETTLED_S:
        raise InsufficientDataError(
            f"inertial scale: expected motion that settles the clock to {1e3 * _CLOCK_SETTLED_S:g} ms, got "
            f"{1e3 * error:.1f} ms; {_REMEDY}"
        )
    limit = _CLOCK_LIMIT * float(problem.prior.sigma[2])
    if abs(clock) > limit:
        raise MismatchError(
            f"inertial scale: expected a sensor's clock right to {1e3 * limit:.0f} ms, got one "
            f"{1e3 * abs(clock):.0f} ms off; find it with `speckle3d calibrate clock`"
        )


def _require_told(found: Solution, sigma: float, scale_sigma: float, s: InertialSettings) -> None:
    if not np.isfinite(sigma) or sigma > s.largest_sigma:
        raise InsufficientDataError(
            f"inertial scale: expected motion that tells the length to {100 * s.largest_sigma:g} %, got "
            f"{100 * sigma:.2g} %; {_REMEDY}"
        )
    off = abs(float(found.values[0]))
    scale_sigma = max(scale_sigma, _CURVES_SIGMA)
    if off > 4.0 * float(np.hypot(sigma, scale_sigma)):
        raise MismatchError(
            f"inertial scale: expected a length within {100 * scale_sigma:.2g} % of the images', got "
            f"{100 * np.expm1(found.values[0]):+.1f} %; check the sensor's units and mounting, and the curves"
        )


def _poses(
    image: RigidTransform,
    sensor: OrientationSensor,
    time_s: FloatArray,
    centre: FloatArray,
    found: Solution,
    sign: FloatArray,
) -> RigidTransform:
    """Chain of the images' in-plane steps, the fitted elevational ones, and the sensor's orientation."""
    turned = _orientation(image, sensor, time_s)
    moved = relative_poses(image).apply(centre) - centre
    moved[:, 2] = np.diff(found.travel_mm)
    # A step is seen from the frame before.
    along = turned[:-1].apply(moved)
    centres = np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    origins = centres - turned.apply(centre)
    return RigidTransform.from_components(origins - origins[0], turned)


def _orientation(image: RigidTransform, sensor: OrientationSensor, time_s: FloatArray) -> Rotation:
    """Orientation of every frame by the sensor; where it lacks one, the images' turn from the nearest."""
    covered = np.flatnonzero(sensor.covers(time_s))
    read = sensor.world_from_image(time_s[covered])
    frames = np.arange(time_s.size)
    after = np.clip(np.searchsorted(covered, frames), 1, covered.size - 1)
    nearest = np.where(frames - covered[after - 1] < covered[after] - frames, after - 1, after)
    return read[nearest] * image.rotation[covered[nearest]].inv() * image.rotation


def _covariance(
    poses: RigidTransform,
    covariance: FloatArray,
    centre: FloatArray,
    scale_sigma: float,
    sigma: float,
    time_s: FloatArray,
    s: InertialSettings,
) -> FloatArray:
    """Covariance of the poses: the images', the errors of scale and turns replaced by the sensor's."""
    out = np.array(covariance, dtype=float)
    z = (poses[0].inv() * poses).apply(centre)[:, 2] - centre[2]
    left = np.maximum(out[:, 2, 2] - (scale_sigma * z) ** 2, 1e-6 + _WANDERING_MM * np.abs(z))
    out[:, 2, :] = out[:, :, 2] = 0.0
    out[:, 3:, :] = out[:, :, 3:] = 0.0
    out[:, 2, 2] = left + (sigma * z) ** 2
    wandered = 2.0 * (1.0 - np.exp(-(time_s - time_s[0]) / s.wander_s))
    out[:, 3:, 3:] = wandered[:, None, None] * turn_covariance(poses[0].rotation, s) + 1e-8 * np.eye(3)
    return out


def turn_covariance(world_from_first: Rotation, settings: InertialSettings) -> FloatArray:
    """Covariance of the sensor's slow errors of tilt, yaw and roll, rad^2, shape (3, 3).

    Parameters
    ----------
    world_from_first : Rotation
        How the first image is turned in the sensor's world, whose z points up: heading is about that.
    """
    inclination, heading = np.deg2rad([settings.orientation_sigma_deg, settings.heading_sigma_deg])
    up = world_from_first.inv().apply([0.0, 0.0, 1.0])
    return np.asarray(inclination**2 * np.eye(3) + (heading**2 - inclination**2) * np.outer(up, up))


def _details(
    found: Solution,
    sigma: float,
    misfit: float,
    signs: SettledSigns,
    problem: InertialProblem,
    s: InertialSettings,
) -> dict[str, float | str]:
    deviation = np.sqrt(np.diag(found.covariance))
    named = dict(zip(GLOBALS, zip(found.values.tolist(), deviation.tolist(), strict=True), strict=True))
    return {
        "scale": float(np.exp(found.values[0])),
        "scale_sigma": sigma,
        "trust": "full" if sigma <= s.trusted_sigma else "weak: the motion tells the length only roughly",
        "chi_squared": misfit,
        "clock_ms": 1e3 * named["clock_s"][0],
        "clock_sigma_ms": 1e3 * named["clock_s"][1],
        "lever_mm": float(np.linalg.norm(found.values[3:6])),
        "lever_sigma_mm": named["lever_y_mm"][1],
        "image_step_error_mm": float(np.median(problem.steps.sigma_mm)),
        "turned_steps": float(signs.turned.sum()),
        "assumption": ASSUMPTION,
    }
