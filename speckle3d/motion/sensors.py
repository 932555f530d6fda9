"""Use of sensors by the image-based motion: its sign and the orientation-consistent patches."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import Doubt
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker, image_orientation
from speckle3d.motion.estimate import Motion, solve_planes
from speckle3d.motion.planes import pair_planes, patch_distances, raised

LEAST_DEVIATIONS = 2.5
"""Product of turns that tells the direction, over what chance gives."""
SAME_CORRELATION = 0.95
"""Correlation at which turns are one motion's, however few of them there are."""
LEAST_FRAMES = 20
"""Frames with readings from which turns are compared."""
ROLL_SHARE = 0.6
"""Share of the variance of the images' roll that a sensor must have in common with it to confirm it."""


class SensorSettings(BaseModel):
    """Settings for the use of sensor streams."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    consistent_subset: bool = Field(
        True, description="In mode `orientation`, drop distances that the sensed orientation contradicts."
    )
    examine: bool = Field(
        True,
        description="Hold sensors against the images and themselves, and refuse those that are contradicted.",
    )
    smooth_s: float = Field(
        0.2,
        ge=0,
        description="Standard deviation of the Gaussian that smooths sensed orientation for the subset.",
    )
    direction: int = Field(
        0,
        ge=-1,
        le=1,
        description="Sign of the first elevational motion; 0: from a sensor, or positive without one.",
    )


def settle_direction(
    sweep: Sweep, image: RigidTransform, settings: SensorSettings, doubts: Iterable[Doubt] = ()
) -> tuple[int, str]:
    """Sign of the elevational motion, which images alone cannot tell, and its source.

    Parameters
    ----------
    doubts : iterable of Doubt
        About the sensors. An orientation sensor is asked if the images' roll confirms its turns or, unless
        there is a doubt about it, its gyroscope.
    """
    if settings.direction:
        return settings.direction, "setting"
    time_s, suspects = sweep.frame_time_s, {doubt.about for doubt in doubts}
    for sensor in (sweep.tracker, sweep.orientation):
        if sensor is None or sensor.sensor_from_image is None:
            continue
        frames = np.flatnonzero(sensor.covers(time_s))
        if isinstance(sensor, Tracker) and frames.size > 1:
            poses = sensor.world_from_image(time_s[frames])
            return _same_way(poses, image[frames], sweep.grid.centre_mm), sensor.label
        if isinstance(sensor, OrientationSensor) and frames.size >= LEAST_FRAMES:
            rotations = sensor.world_from_image(time_s[frames]), image[frames].rotation
            turns, image_turns = ((turn[0].inv() * turn).as_rotvec() for turn in rotations)
            roll, image_roll = turns[:, 2], image_turns[:, 2]
            by_roll = np.var(roll - image_roll) < (1.0 - ROLL_SHARE) * np.var(image_roll)
            by_gyroscope = sensor.gyroscope_rad_s is not None and sensor.label not in suspects
            is_confirmed = by_roll or by_gyroscope or not settings.examine
            sign = same_turns(turns[:, :2], image_turns[:, :2]) if is_confirmed else None
            if sign is not None:
                return sign, sensor.label
    if sweep.truth is not None:
        return _same_way(sweep.truth, image, sweep.grid.centre_mm), "truth"
    return 1, "assumed"


def _same_way(poses: RigidTransform, image: RigidTransform, centre_mm: FloatArray) -> int:
    """Sign of the correlation of two records of poses along the first frame's normal."""
    z, image_z = ((path[0].inv() * path).apply(centre_mm)[:, 2] for path in (poses, image))
    return 1 if np.cov(z, image_z)[0, 1] >= 0 else -1


def same_turns(sensor_turns: FloatArray, image_turns: FloatArray) -> int | None:
    """Sign of the correlation of two records of turns; None if it is not significant.

    Told are a product that chance does not give records as slow as these, and the near correlation that the
    same motion gives.

    Parameters
    ----------
    sensor_turns, image_turns : ndarray, shape (n, 2)
        Tilt and yaw of each frame, rad.

    References
    ----------
    .. [1] M. S. Bartlett, "Some aspects of the time-correlation problem in regard to tests of significance",
       Journal of the Royal Statistical Society 98, 1935: the variance of a correlation of series that change
       slowly.
    """
    n = len(sensor_turns)
    trend = np.vander(np.linspace(-1, 1, n), 3)
    sensor_part, image_part = (
        v - trend @ np.linalg.lstsq(trend, v, rcond=None)[0] for v in (sensor_turns, image_turns)
    )
    product = float(np.sum(sensor_part * image_part))
    # Variance of the sum of products of independent series with these autocovariances (Bartlett).
    columns = zip(sensor_part.T, image_part.T, strict=True)
    by_lag = sum(np.correlate(a, a, "full") * np.correlate(b, b, "full") for a, b in columns)
    by_chance = np.sqrt(max(float((1.0 - np.abs(np.arange(1 - n, n)) / n) @ by_lag) / n, 0.0))
    nearly_equal = abs(product) > SAME_CORRELATION * np.linalg.norm(sensor_part) * np.linalg.norm(image_part)
    return int(np.sign(product)) if nearly_equal or abs(product) > LEAST_DEVIATIONS * by_chance else None


def sensed_orientation(sweep: Sweep, settings: SensorSettings) -> Rotation | None:
    """Smoothed orientation of every frame; None if the subset is off or too few frames have a reading.

    Frames without one take that of the nearest frame, which may be `SensorSettings.smooth_s` away.
    """
    sensor, time_s, sigma_s = sweep.orientation or sweep.tracker, sweep.frame_time_s, settings.smooth_s
    if not settings.consistent_subset or sensor is None or sensor.sensor_from_image is None:
        return None
    read_s = time_s[sensor.covers(time_s)]
    if not read_s.size:
        return None
    nearest_s = read_s[np.rint(np.interp(time_s, read_s, np.arange(read_s.size))).astype(int)]
    if np.abs(nearest_s - time_s).max() > sigma_s:
        return None
    orientation = image_orientation(sensor, nearest_s)
    if sigma_s == 0:
        return orientation
    # As turns from their mean, of which they stay within a half turn; a steady turn goes on beyond the ends.
    mean, frames = orientation.mean(), sigma_s / float(np.median(np.diff(time_s)))
    turns, margin = (mean.inv() * orientation).as_rotvec(), min(math.ceil(4.0 * frames), len(sweep) - 1)
    turns = np.pad(turns, ((margin, margin), (0, 0)), "reflect", reflect_type="odd")
    return mean * Rotation.from_rotvec(gaussian_filter1d(turns, frames, axis=0)[margin:-margin])


class ConsistentPoses(NamedTuple):
    """Poses from the orientation-consistent patches.

    Attributes
    ----------
    poses : RigidTransform, length n, or None
        None without a sensed orientation.
    used : ndarray of bool, shape (e, p)
        Patches of each pair that they come from.
    rejected_share : float
        Share of the measured patches that they do not come from; NaN without poses.
    """

    poses: RigidTransform | None
    used: BoolArray
    rejected_share: float


def consistent_poses(motion: Motion, sweep: Sweep, settings: SensorSettings) -> ConsistentPoses:
    """Poses from the orientation-consistent patches.

    Planes have the sensed orientation and go through the patches that agree with it; pairs of which too few
    do keep their own.

    Parameters
    ----------
    motion : Motion
        Of the true sign.
    sweep : Sweep
        With the sensors that are to be used.
    """
    orientation = sensed_orientation(sweep, settings)
    if orientation is None:
        return ConsistentPoses(None, motion.pairs.used, float("nan"))
    problem, table, pairs, scale = motion.problem, motion.table, motion.pairs, motion.coherence.scale
    models, correlation = motion.coherence.models(pairs.first), table.correlation[pairs.row]
    sign = np.where(pairs.offset_mm < 0, -1.0, 1.0)
    relative = (orientation[pairs.first].inv() * orientation[pairs.second]).as_matrix()[:, 2, :2]
    shift, slopes = table.inplane[pairs.row, :2], sign[:, None] * relative
    farther = raised(problem, shift, slopes)
    # Only frames that cross, or nearly, leave the side open.
    open_side = np.abs(pairs.offset_mm) < np.ptp(farther, axis=1)
    distance, sigma = (scale * v for v in patch_distances(problem, correlation, models))
    agreement = consistent_subset(distance, sigma, farther, open_side, problem.planes.support_sigma)
    planes, firm = pair_planes(problem, table, pairs.row, models, agreement, slopes, open_side)
    every, every_firm = pair_planes(problem, table, pairs.row, models, True, slopes, open_side)
    # The patches that most agree are those of the commonest distance, which is short of the mean where echoes
    # differ: the subset says which way frames turn, all patches how far apart they are.
    near, far = (p.offset_mm[firm & every_firm] for p in (planes, every))
    factor = scale * float(near @ far / (near @ near)) if near.any() else scale
    # Slopes are the sensor's.
    planes.coefficients[:] *= [factor, 1.0, 1.0] * sign[:, None]
    planes.covariance[:] *= factor**2
    for name in ("coefficients", "covariance", "used"):
        getattr(planes, name)[~firm] = getattr(pairs, name)[~firm]
    rejected_share = 1.0 - float(planes.used[pairs.used].mean())
    return ConsistentPoses(solve_planes(problem, table, planes)[1].poses, planes.used, rejected_share)


def consistent_subset(
    distance_mm: FloatArray,
    sigma_mm: FloatArray,
    raised_mm: FloatArray,
    either_side: BoolArray,
    support_sigma: float,
) -> BoolArray:
    """Patches of each pair whose distances agree with one plane of the sensed orientation.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    distance_mm, sigma_mm : ndarray, shape (e, p)
        NaN where a patch holds no distance.
    raised_mm : ndarray, shape (e, p)
        How much farther each patch is than the image's centre, by the sensor's relative rotation.
    either_side : ndarray of bool, shape (e,)
        Whether the image's centre may lie on the other side of the first frame than `raised_mm` has it.

    Returns
    -------
    ndarray of bool, shape (e, p)

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    support = np.zeros(raised_mm.shape, dtype=bool)
    for pair, finite in enumerate(np.isfinite(distance_mm)):
        if not finite.any():
            continue
        d, sigma, farther = (v[pair, finite].astype("f4") for v in (distance_mm, sigma_mm, raised_mm))
        offset = np.concatenate([d - farther, -d - farther] if either_side[pair] else [d - farther])
        misfit = np.abs((np.abs(offset[:, None] + farther) - d) / sigma)
        agree = misfit <= support_sigma
        # Among placements of equal support, the one whose supporters lie closest.
        score = agree.sum(axis=1) - (agree * misfit).sum(axis=1) / (d.size * support_sigma + 1.0)
        support[pair, finite] = agree[score.argmax()]
    return support
