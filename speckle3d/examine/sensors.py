"""Check sensors against their own readings; only self-contradiction leaves one out.

What images and sensors say differently is in `speckle3d.examine.disagreements`: either may be wrong.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import DECISIVE, Doubt, MismatchError
from speckle3d.core.geometry import nearest_rotation, rigid
from speckle3d.core.leastsquares import MAD_TO_SIGMA, robust_sigma
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker

REFUTED = 2.0
"""Doubts refute from so many times the figure from which they are told."""
MOST_STILL = 0.2
"""Share of the sweep over which readings that do not change at all refute a sensor."""
LEAST_TRAVEL_MM = 0.5
"""By which images must have moved meanwhile: a probe may rest, and a simulated sensor have no noise."""
DOUBTFUL_JITTER = 2.5
"""Jitter of a step, mm and degrees, that is told; of sensors in use below 0.5 and 0.3."""
SMOOTH = 9
"""Readings of which the running median is taken: neither jitter nor four spikes in a row move it."""
_SPIKE_SIGMA = 10.0
_SPIKE = float(np.deg2rad(5.0)), 3.0
"""Turn, rad, and distance, mm, that no hand goes and comes back between readings: at 50 Hz it would take 220
rad/s^2 and 7 m/s^2."""
_SLIP = float(np.deg2rad(300.0)), 250.0
"""Rates, rad/s and mm/s, of no scan, from one reading to the next."""
_STILL = np.sqrt(np.finfo(float).eps)
"""Readings closer than this are the same: noise moves the last digits of any sensor that is read."""
_LEAST_JITTER = np.array([1e-4, 0.03])
"""Jitter of turns, rad, and places, mm, that is a tracker's noise: a stage has none, an exactly measured hand
2e-4 and 0.015 at 50 Hz by its tremor, trackers 0.1 mm and more."""
TURN_S = 0.3
"""A hand's wobble turns round within this time; over longer ones a gyroscope's bias counts."""
WALK_DEG, SCALE_ERROR = 0.03, 0.05
"""Random walk of a gyroscope over `TURN_S`, and the share of a turn by which readings honestly differ."""
MOST_BIAS_DEG_S = 3.0
"""Biases of gyroscopes in orientation sensors are below 1 degree/s once they have stood still."""
TILTED_DEG = 10.0
"""Angle between gravity and the world's z that contradicts a sensor."""


def examine_sensors(
    sweep: Sweep, image: RigidTransform, examine: bool = True
) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Check a sweep's sensors; return the sweep without contradicted readings, and the doubts.

    Parameters
    ----------
    image : RigidTransform, length n
        Image-based poses, of either sign of the elevational motion: they tell whether the probe moved.
    """
    if not examine:
        return sweep, ()
    sweep, doubts = repair_readings(sweep)
    sweep = credible_sensors(sweep, doubts)
    for sensor in (sweep.tracker, sweep.orientation):
        if sensor is not None:
            place, turn = jitter(rigid(sensor.readings.world_from_sensor), np.zeros(3))
            odd = (
                *_doubt_still(sensor, sweep, image, (turn, place)),
                *_doubt_jitter(sensor.label, place, turn),
            )
            if not odd and isinstance(sensor, OrientationSensor):
                odd = (*doubts_of_gyroscope(sensor, turn), *doubts_of_gravity(sensor))
            doubts += odd
    return credible_sensors(sweep, doubts), doubts


def repair_readings(sweep: Sweep) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Remove spikes from readings; report spikes and jumps."""
    doubts: list[Doubt] = []
    for name in ("tracker", "orientation"):
        sensor = getattr(sweep, name)
        if sensor is None:
            continue
        wild = spikes(sensor)
        if wild.any():
            evidence = f"{int(wild.sum())} of {wild.size} readings jump away from those around them and back"
            where = frames_at(sensor, np.flatnonzero(wild), sweep.frame_time_s)
            doubts.append(Doubt(sensor.label, "spikes", f"{evidence}, and are left out", False, where))
            sensor = without(sensor, wild)
            sweep = replace(sweep, **{name: sensor})
        doubts += _doubt_jumps(sensor, sweep.frame_time_s)
    return sweep, tuple(doubts)


def credible_sensors(sweep: Sweep, doubts: Iterable[Doubt]) -> Sweep:
    """The sweep without refuted sensors."""
    refuted = {doubt.about for doubt in doubts if doubt.refuted}
    return replace(
        sweep,
        tracker=None if Tracker.label in refuted else sweep.tracker,
        orientation=None if OrientationSensor.label in refuted else sweep.orientation,
    )


def require_credible(doubts: Iterable[Doubt], sensor: OrientationSensor | Tracker | None, where: str) -> None:
    """Raise `MismatchError` if a sensor is refuted."""
    for doubt in doubts:
        if sensor is not None and doubt.refuted and doubt.about == sensor.label:
            raise MismatchError(f"{where}: {doubt}; sensors.examine = false uses it as it is")


def _doubt_jitter(label: str, place_mm: float, turn_rad: float) -> Iterator[Doubt]:
    # A step varies twice as much as a reading.
    size = np.sqrt(2.0) * place_mm, np.sqrt(2.0) * np.rad2deg(turn_rad)
    if max(size) > DOUBTFUL_JITTER:
        evidence = f"expected a steady path, got a jitter of {size[0]:.2g} mm and {size[1]:.2g} degrees"
        yield Doubt(label, "noise or scrambled values", evidence, max(size) > REFUTED * DOUBTFUL_JITTER)


def _doubt_jumps(sensor: OrientationSensor | Tracker, frame_time_s: FloatArray) -> Iterator[Doubt]:
    """Doubt readings that jump and stay: a slipped sensor, or a tracker that recovered."""
    poses = rigid(sensor.readings.world_from_sensor)
    if len(poses) < 2:
        return
    rate = _steps(poses[:-1], poses[1:]) / np.diff(sensor.readings.time_s)
    limit = np.maximum(_SLIP, _SPIKE_SIGMA * np.median(rate, axis=1))
    jumps = np.flatnonzero((rate > limit[:, None]).any(axis=0)) + 1
    if jumps.size:
        evidence = f"expected a path that a hand can follow, got {jumps.size} jumps in it"
        where = frames_at(sensor, jumps, frame_time_s)
        yield Doubt(sensor.label, "slip, or readings lost and found elsewhere", evidence, False, where)


def _doubt_still(
    sensor: OrientationSensor | Tracker, sweep: Sweep, image: RigidTransform, noise: tuple[float, float]
) -> Iterator[Doubt]:
    """Doubt readings, or the turns or places of a tracker, that stay identical while the images move.

    Parameters
    ----------
    noise : (float, float)
        Jitter of turns, rad, and places, mm: turns or places that never change beside others that jitter are
        not measured. Those of a stage do not jitter.
    """
    poses, read_s = rigid(sensor.readings.world_from_sensor), sensor.readings.time_s
    parts = _steps(poses[:-1], poses[1:]) < _STILL
    stuck = parts.all(axis=1) & (np.array(noise) > _LEAST_JITTER)[::-1] & isinstance(sensor, Tracker)
    still = parts.all(axis=0) | stuck.any()
    what = "turn" if stuck[0] else "place" if stuck[1] else "one"
    runs = [(read_s[first], read_s[last + 1]) for first, last in runs_of(np.flatnonzero(still))]
    begin, end = max(runs, key=np.ptp, default=(0.0, -1.0))
    time_s = sweep.frame_time_s - sensor.time_offset_s
    during = (time_s >= begin) & (time_s <= end)
    if during.sum() < 2:
        return
    same_s, whole_s = float(np.ptp(time_s[during])), float(np.ptp(time_s))
    path_mm = image[during].apply(sweep.grid.centre_mm)
    travel_mm = float(np.linalg.norm(path_mm - path_mm[0], axis=1).max())
    # Loggers repeat a reading until the next: it is as old as one that interpolation still bridges.
    bridged_s = sensor.readings.max_gap_s
    if travel_mm > LEAST_TRAVEL_MM and same_s > bridged_s:
        evidence = f"expected readings that change, got the same {what} for {same_s:.2f} of {whole_s:.2f} s"
        where = runs_of(np.flatnonzero(during))
        most_s = max(MOST_STILL * whole_s, REFUTED * bridged_s)
        yield Doubt(sensor.label, "frozen", evidence, same_s > most_s, where)


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
    """Robust standard deviation by column."""
    away = np.abs(values - np.median(values, axis=0))
    return np.asarray(MAD_TO_SIGMA * np.median(away, axis=0))


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
    if contradicted and gain > max(DECISIVE, misfit(left) - misfit(difference(readings, -1.0))):
        evidence = f"expected turns as its gyroscope's, so they fit better by {gain:.0f} in log likelihood"
        yield Doubt(sensor.label, name, evidence, True)
    # Readings that jitter beside a slow hand still turn as the gyroscope does, better than not at all.
    elif contradicted and still > DECISIVE:
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
    return float(np.degrees(np.arccos(np.clip(up[2] / size, -1.0, 1.0)))) if size > 0 else float("nan")


def _steps(poses: RigidTransform, targets: RigidTransform) -> FloatArray:
    """Turn, rad, and distance, mm, from poses to others, shape (2, n)."""
    distance = np.linalg.norm(targets.translation - poses.translation, axis=1)
    return np.stack([(poses.rotation.inv() * targets.rotation).magnitude(), distance])


def spikes(sensor: OrientationSensor | Tracker) -> BoolArray:
    """Mask of readings far off the median of those around them, shape (m,)."""
    poses = rigid(sensor.readings.world_from_sensor)
    place = median_filter(poses.translation, (SMOOTH, 1), mode="mirror")
    matrix = median_filter(poses.rotation.as_matrix(), (SMOOTH, 1, 1), mode="mirror")
    turn = Rotation.from_matrix(nearest_rotation(matrix))
    off = _steps(RigidTransform.from_components(place, turn), poses)
    limits = [max(most, _SPIKE_SIGMA * robust_sigma(size)) for most, size in zip(_SPIKE, off, strict=True)]
    return np.asarray((off > np.array(limits)[:, None]).any(axis=0))


def frames_at(
    sensor: OrientationSensor | Tracker, readings: IntArray, frame_time_s: FloatArray
) -> tuple[tuple[int, int], ...]:
    """Frames nearest to some readings; none for those before the first frame or after the last."""
    time_s = sensor.readings.time_s[readings] + sensor.time_offset_s
    time_s = time_s[(time_s >= frame_time_s[0]) & (time_s <= frame_time_s[-1])]
    middle = (frame_time_s[:-1] + frame_time_s[1:]) / 2
    return runs_of(np.searchsorted(middle, time_s))


def without(sensor: Any, left_out: BoolArray) -> Any:
    """The sensor less some of its readings, and what was measured with them."""
    keep, readings = ~left_out, sensor.readings
    less = replace(readings, time_s=readings.time_s[keep], world_from_sensor=readings.world_from_sensor[keep])
    others = {name: value[keep] for name, value in vars(sensor).items() if isinstance(value, np.ndarray)}
    return replace(sensor, readings=less, **others)


def jitter(poses: RigidTransform, at_mm: FloatArray) -> tuple[float, float]:
    """Standard deviation of the place of a point, mm, and of the turn, rad, of poses but for slow motion."""
    if len(poses) < 3:
        return 0.0, 0.0
    turns = (poses.rotation.mean().inv() * poses.rotation).as_rotvec()
    # A second difference of white noise varies six times as much.
    second = (np.diff(values, 2, axis=0) / np.sqrt(6.0) for values in (poses.apply(at_mm), turns))
    place, turn = (max(robust_sigma(column) for column in component.T) for component in second)
    return place, turn


def runs_of(frames: IntArray) -> tuple[tuple[int, int], ...]:
    """First and last of every run of consecutive frames.

    Parameters
    ----------
    frames : ndarray of int
        In any order; any number of times each.

    Examples
    --------
    >>> runs_of(np.array([7, 3, 4, 4]))
    ((3, 4), (7, 7))
    """
    numbers = np.unique(frames)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return tuple((int(run[0]), int(run[-1])) for run in runs if run.size)
