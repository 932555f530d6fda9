"""Changes of sweeps, of sensors' streams and of curves, from which `faults` is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, RFSettings, Sweep, Tracker
from speckle3d.simulation.movement import HandMotion, Trajectory, hand_sweep
from speckle3d.simulation.sensors import GRAVITY_M_S2

Change = Callable[[Sweep, np.random.Generator], Sweep]


def of_tracker(change: Callable[..., RigidTransform], *given: Any) -> Change:
    """Change the readings' poses."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        tracker = sweep.tracker
        poses = change(tracker.readings.world_from_sensor, rng, *given)
        return replace(sweep, tracker=replace(tracker, readings=TimedPoses(tracker.readings.time_s, poses)))

    return changed


def scaled(poses: RigidTransform, rng: np.random.Generator, factor: Any) -> RigidTransform:
    return RigidTransform.from_components(poses.translation * factor, poses.rotation)


def held(poses: Any, rng: np.random.Generator, first: float, last: float = 1.0) -> Any:
    """Repeat the reading at share `first` until share `last`."""
    index = np.arange(len(poses))
    start, stop = int(first * len(poses)), int(last * len(poses))
    index[start:stop] = start
    return poses[index]


def sampled_and_held(poses: Any, rng: np.random.Generator, every: int) -> Any:
    return poses[np.arange(len(poses)) // every * every]


def seen_in_mirror(poses: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    return RigidTransform.from_matrix(flip @ poses.as_matrix() @ flip)


def swapped_axes(poses: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    swap = np.eye(4)[[0, 2, 1, 3]]
    return RigidTransform.from_matrix(swap @ poses.as_matrix() @ swap)


def transposed(poses: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_components(poses.translation, poses.rotation.inv())


def jumping(poses: RigidTransform, rng: np.random.Generator, share: float, jump_mm: float) -> RigidTransform:
    towards = rng.standard_normal((len(poses), 3))
    towards *= jump_mm / np.linalg.norm(towards, axis=1, keepdims=True)
    moved = poses.translation + towards * (rng.random((len(poses), 1)) < share)
    return RigidTransform.from_components(moved, poses.rotation)


def noisy(poses: RigidTransform, rng: np.random.Generator, mm: float) -> RigidTransform:
    moved = poses.translation + mm * rng.standard_normal((len(poses), 3))
    return RigidTransform.from_components(moved, poses.rotation)


def walking(poses: RigidTransform, rng: np.random.Generator, mm: float) -> RigidTransform:
    """Drift by `mm` over the recording in one direction."""
    towards = rng.standard_normal(3)
    towards *= mm / np.linalg.norm(towards)
    moved = poses.translation + np.linspace(0.0, 1.0, len(poses))[:, None] * towards
    return RigidTransform.from_components(moved, poses.rotation)


def random_poses(poses: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    n = len(poses)
    return RigidTransform.from_components(rng.uniform(-300, 300, (n, 3)), Rotation.random(n, rng=rng))


def inverted(poses: Any, rng: np.random.Generator) -> Any:
    return poses.inv()


def mounted(which: str, turn: Callable[[Any], Any]) -> Change:
    """Change where the image is on a sensor."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        sensor = getattr(sweep, which)
        return replace(sweep, **{which: replace(sensor, sensor_from_image=turn(sensor.sensor_from_image))})

    return changed


def mount_turned(degrees: float, axis: str, mount: Any) -> Any:
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    return mount * (RigidTransform.from_rotation(turn) if isinstance(mount, RigidTransform) else turn)


def clock_late(which: str, by_s: float) -> Change:
    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        sensor = getattr(sweep, which)
        return replace(sweep, **{which: replace(sensor, time_offset_s=sensor.time_offset_s + by_s)})

    return changed


def clock_rate(which: str, factor: float) -> Change:
    """A sensor's clock that runs at another rate, right in the sweep's middle."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        sensor = getattr(sweep, which)
        middle = float(np.mean(sweep.frame_time_s[[0, -1]])) - sensor.time_offset_s
        times = middle + factor * (sensor.readings.time_s - middle)
        return replace(sweep, **{which: replace(sensor, readings=replace(sensor.readings, time_s=times))})

    return changed


def elsewhere(sweep: Sweep, rng: np.random.Generator) -> Trajectory:
    """Motion of another sweep of the same duration."""
    duration = float(np.ptp(sweep.frame_time_s))
    world = RigidTransform.from_components(rng.uniform(-300, 300, 3), Rotation.random(rng=rng))
    length = rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 16.0)
    start = RigidTransform.identity()
    return hand_sweep(length, duration, sweep.grid.width_mm, HandMotion(), start, world, rng)


def times_elsewhere(sweep: Sweep, sensor: Tracker | OrientationSensor) -> np.ndarray:
    times = sensor.readings.time_s + sensor.time_offset_s - sweep.frame_time_s[0]
    return np.clip(times, -0.49, float(np.ptp(sweep.frame_time_s)) + 0.49)


def tracker_of_another(sweep: Sweep, rng: np.random.Generator) -> Sweep:
    tracker = sweep.tracker
    path, times = elsewhere(sweep, rng), times_elsewhere(sweep, tracker)
    poses = path.world_from_image(times) * tracker.sensor_from_image.inv()
    noise = Rotation.from_rotvec(np.deg2rad(0.1) * rng.standard_normal((times.size, 3)))
    poses = poses * RigidTransform.from_components(0.15 * rng.standard_normal((times.size, 3)), noise)
    return replace(sweep, tracker=replace(tracker, readings=TimedPoses(tracker.readings.time_s, poses)))


def of_orientation(change: Callable[..., Rotation], *given: Any) -> Change:
    """Change the readings' orientations, and leave the inertial readings."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        sensor = sweep.orientation
        turned = change(sensor.readings.world_from_sensor, rng, *given)
        return replace(
            sweep, orientation=replace(sensor, readings=TimedRotations(sensor.readings.time_s, turned))
        )

    return changed


def stored_xyzw(turned: Rotation, rng: np.random.Generator) -> Rotation:
    return Rotation.from_quat(turned.as_quat(scalar_first=False), scalar_first=True)


def with_factors(turned: Rotation, rng: np.random.Generator, wxyz: list[float]) -> Rotation:
    return Rotation.from_quat(turned.as_quat(scalar_first=True) * wxyz, scalar_first=True)


def rounded(turned: Rotation, rng: np.random.Generator, decimals: int) -> Rotation:
    return Rotation.from_quat(turned.as_quat().round(decimals))


def random_turns(turned: Rotation, rng: np.random.Generator) -> Rotation:
    return Rotation.random(len(turned), rng=rng)


def flipping(turned: Rotation, rng: np.random.Generator, share: float) -> Rotation:
    axis = rng.standard_normal((len(turned), 3))
    axis *= np.pi / np.linalg.norm(axis, axis=1, keepdims=True)
    return turned * Rotation.from_rotvec(axis * (rng.random((len(turned), 1)) < share))


def heading_drift(sweep: Sweep, rng: np.random.Generator) -> Sweep:
    time_s = sweep.orientation.readings.time_s
    turn = Rotation.from_rotvec(np.outer(np.deg2rad(5.0) * (time_s - time_s[0]), [0, 0, 1]))
    return of_orientation(lambda turned, _: turn * turned)(sweep, rng)


def inertial(name: str, factor: float) -> Change:
    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        sensor = sweep.orientation
        return replace(sweep, orientation=replace(sensor, **{name: factor * getattr(sensor, name)}))

    return changed


def stream_of_another(sweep: Sweep, rng: np.random.Generator) -> Sweep:
    """All of the sensor's readings, gyroscope and accelerometer with them, of another sweep."""
    sensor = sweep.orientation
    path, times, half = elsewhere(sweep, rng), times_elsewhere(sweep, sensor), 1e-3
    mount = sensor.sensor_from_image.inv()
    before, turned, after = (path.world_from_image(times + d).rotation * mount for d in (-half, 0.0, half))
    white = Rotation.from_rotvec(np.deg2rad(0.03) * rng.standard_normal((times.size, 3)))
    readings = TimedRotations(sensor.readings.time_s, turned * white)
    values: dict[str, Any] = {"magnetometer_au": None}
    if sensor.gyroscope_rad_s is not None:
        noise = rng.standard_normal((2, times.size, 3))
        rate = (before.inv() * after).as_rotvec() / (2 * half)
        values["gyroscope_rad_s"] = rate + np.deg2rad(0.6) * noise[0]
        values["accelerometer_m_s2"] = turned.inv().apply([0.0, 0.0, GRAVITY_M_S2]) + 0.015 * noise[1]
    return replace(sweep, orientation=replace(sensor, readings=readings, **values))


def of_images(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Change:
    """Change the frames, shape (frame, vector, sample); the truth stays."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        frames = all_frames(sweep)
        made = change(frames.astype(np.float64), rng)
        return replace(sweep, frames=np.clip(np.rint(made), -8191, 8191).astype(frames.dtype))

    return changed


def in_order(index: Callable[[int], np.ndarray]) -> Change:
    """Show other frames in place of each, with their truth and under the same clocks."""

    def changed(sweep: Sweep, rng: np.random.Generator) -> Sweep:
        chosen = index(len(sweep))
        truth = None if sweep.truth is None else sweep.truth[chosen]
        return replace(sweep, frames=all_frames(sweep)[chosen], truth=truth)

    return changed


def all_frames(sweep: Sweep) -> np.ndarray:
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def resting(frames: np.ndarray, rng: np.random.Generator, snr_db: float) -> np.ndarray:
    """The first frame again and again under white noise."""
    rms = frames[0].std() * 10.0 ** (-snr_db / 20.0)
    return frames[:1] + rms * rng.standard_normal(frames.shape)


def clutter(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Echoes as strong as speckle that stay where they are in the image: the last frame, left to right."""
    still = frames[-1, ::-1]
    return frames + still * (frames.std(axis=(0, 1)) / np.maximum(still.std(axis=0), 1e-9)).mean()


def interleaved(n: int) -> np.ndarray:
    """Frames of the first and of the second half in turns."""
    index = np.arange(n)
    return np.minimum(index // 2 + (index % 2) * (n // 2), n - 1)


def frozen_display(n: int) -> np.ndarray:
    index = np.arange(n)
    index[n // 3 : n // 2] = n // 3
    return index


def keyed_twice(sweep: Sweep, rng: np.random.Generator) -> Sweep:
    signal = sweep.signal
    assert isinstance(signal, RFSettings)
    grid = replace(sweep.grid, sample_spacing_mm=sweep.grid.sample_spacing_mm / 2.0)
    return replace(sweep, signal=twice(signal), grid=grid)


def twice(signal: RFSettings) -> RFSettings:
    low, high = signal.bandwidth_hz
    return RFSettings(
        2 * signal.sampling_rate_hz,
        signal.speed_of_sound_m_s,
        2 * signal.centre_frequency_hz,
        (2 * low, 2 * high),
    )


def depths(curves: DecorrelationCurves, change: Callable[[np.ndarray], np.ndarray]) -> DecorrelationCurves:
    return replace(curves, depth_mm=change(curves.depth_mm))


def stretched(curves: DecorrelationCurves, factor: float) -> DecorrelationCurves:
    tilt = curves.tilt
    if tilt is not None:
        tilt = replace(tilt, pivot_mm=factor * tilt.pivot_mm, spread_mm=factor * tilt.spread_mm)
    return replace(curves, distance_mm=factor * curves.distance_mm, tilt=tilt)


def upside_down(curves: DecorrelationCurves) -> DecorrelationCurves:
    tilt = curves.tilt
    if tilt is not None:
        tilt = replace(tilt, pivot_mm=tilt.pivot_mm[::-1], spread_mm=tilt.spread_mm[::-1])
    return replace(curves, correlation=curves.correlation[::-1], cells=curves.cells[::-1], tilt=tilt)


def on_64_to_100_mm(depth_mm: np.ndarray) -> np.ndarray:
    return 64.0 + 36.0 * (depth_mm - depth_mm[0]) / np.ptp(depth_mm)
