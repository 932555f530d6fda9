"""An orientation sensor against its own gyroscope and accelerometer, in each convention possibly mistaken."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.sweep import OrientationSensor

TURN_S = 0.3
"""A hand's wobble turns round within this time; over longer ones a gyroscope's bias counts."""
WALK_DEG, SCALE_ERROR = 0.03, 0.05
"""Random walk of a gyroscope over `TURN_S`, and the share of a turn by which readings honestly differ."""
LEAST_GAIN = 4.0
"""Logarithm of the likelihood by which a convention must explain the gyroscope better: good simulated sensors
gain up to 0.1, faulty ones from 5."""
MOST_BIAS_DEG_S = 3.0
"""Biases of gyroscopes in orientation sensors are below 1 degree/s once they have stood still."""
TILTED_DEG = 10.0
"""Angle between gravity and the world's z that contradicts a sensor."""


def conventions(turned: Rotation) -> Iterator[tuple[str, Rotation]]:
    """Readings as they would be if a convention had been mistaken, and its name."""
    xyzw = turned.as_quat()
    yield "quaternions stored xyzw for wxyz", Rotation.from_quat(xyzw[:, [3, 0, 1, 2]])
    yield "quaternions wxyz taken for xyzw", Rotation.from_quat(xyzw[:, [1, 2, 3, 0]])
    yield "quaternions inverted", turned.inv()
    for axis, unit in zip("xyz", np.eye(3), strict=True):
        flip = np.diag(1.0 - 2.0 * unit)
        yield f"handedness: {axis} mirrored", Rotation.from_matrix(flip @ turned.as_matrix() @ flip)


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviation by column, from the median distance to the median."""
    return np.asarray(1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0))


def doubts_of_gyroscope(sensor: OrientationSensor, jitter_rad: float) -> Iterator[Doubt]:
    """At most one: the convention in which readings turn as the gyroscope, or that they do not.

    A turn has the jitter of two readings.
    """
    rate, time_s, readings = sensor.gyroscope_rad_s, sensor.readings.time_s, sensor.readings.world_from_sensor
    if rate is None or len(time_s) < 2:
        return
    pause = np.diff(time_s)
    lag = max(1, round(TURN_S / float(np.median(pause))))
    if len(time_s) <= 2 * lag:
        return
    angle = np.cumsum((rate[1:] + rate[:-1]) / 2 * pause[:, None], axis=0)
    angle = np.concatenate([np.zeros((1, 3)), angle])
    turns = np.rad2deg(angle[lag:] - angle[:-lag])
    noise = WALK_DEG + np.sqrt(2.0) * np.rad2deg(jitter_rad) + SCALE_ERROR * float(_spread(turns).max())

    def difference(turned: Rotation, sign: float = 1.0) -> FloatArray:
        """Turns by the gyroscope, or the opposite ones, less those by readings, degrees."""
        return sign * turns - (turned[:-lag].inv() * turned[lag:]).as_rotvec(degrees=True)

    def misfit(left: FloatArray) -> float:
        """Negative log likelihood but for a bias; overlapping turns count once."""
        return float(len(turns) / lag * np.log(_spread(left) ** 2 + noise**2).sum())

    left = difference(readings)
    upright = [
        (misfit(left) - misfit(difference(other)), name)
        for name, other in conventions(readings)
        if not _gravity_from_vertical(sensor, other) > TILTED_DEG
    ]
    gain, name = max(upright, default=(0.0, ""))
    still = misfit(left) - misfit(turns)
    bias = float(np.linalg.norm(np.median(left, axis=0))) / (lag * float(np.median(pause)))
    contradicted = float(_spread(left).max()) > noise
    # The gyroscope's sign may be the mistaken one.
    if contradicted and gain > max(LEAST_GAIN, misfit(left) - misfit(difference(readings, -1.0))):
        evidence = f"expected turns as its gyroscope's, so they fit better by {gain:.0f} in log likelihood"
        yield Doubt(sensor.label, name, evidence, True)
    # Readings that jitter beside a slow hand still turn as the gyroscope does, better than not at all.
    elif contradicted and still > LEAST_GAIN:
        evidence = f"expected turns as its gyroscope's, no turn fits better by {still:.0f} in log likelihood"
        yield Doubt(sensor.label, "gyroscope on other axes, or quaternions of another kind", evidence, False)
    elif bias > MOST_BIAS_DEG_S:
        evidence = f"expected turns as its gyroscope's, got {bias:.1f} degrees/s more"
        yield Doubt(sensor.label, "heading drift, or a gyroscope's bias", evidence, False)


def doubts_of_gravity(sensor: OrientationSensor) -> Iterator[Doubt]:
    """At most one: gravity is not along the world's z; refuted if a convention brings it there."""
    readings = sensor.readings.world_from_sensor
    degrees = _gravity_from_vertical(sensor, readings)
    if not degrees > TILTED_DEG:
        return
    mended = [
        name for name, other in conventions(readings) if _gravity_from_vertical(sensor, other) < TILTED_DEG
    ]
    suspect = (mended or ["a world whose z is not vertical, or an accelerometer on other axes"])[0]
    evidence = f"expected gravity along the world's z, got it {degrees:.0f} degrees off"
    yield Doubt(sensor.label, suspect, evidence, bool(mended))


def _gravity_from_vertical(sensor: OrientationSensor, readings: Rotation) -> float:
    """Angle between gravity, as readings turn it, and the world's z, degrees; NaN if not measured."""
    if sensor.accelerometer_m_s2 is None:
        return float("nan")
    up = np.median(readings.apply(sensor.accelerometer_m_s2), axis=0)
    size = float(np.linalg.norm(up))
    return float(np.degrees(np.arccos(min(1.0, abs(float(up[2])) / size)))) if size > 0 else float("nan")
