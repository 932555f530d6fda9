"""Faults put into good recordings: what cables, converters, calibrations and operators do wrong to a sensor.

``spoil(sweep, "tracker in metres")`` is the sweep with that fault of `FAULTS`.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.streams import TimedPoses, TimedRotations


def spoil(sweep, name):
    """The sweep with a fault of its tracker or orientation sensor, by which its name begins."""
    rng = np.random.default_rng([0, *name.encode()])
    sensor = name.split()[0]
    return replace(sweep, **{sensor: FAULTS[name](sweep, getattr(sweep, sensor), rng)})


def _readings(change):
    """Change a sensor's poses or rotations, and leave its clock and what else it measures."""

    def spoilt(sweep, sensor, rng):
        stream = sensor.readings
        kind = TimedPoses if isinstance(stream, TimedPoses) else TimedRotations
        return replace(sensor, readings=kind(stream.time_s, change(stream.world_from_sensor, rng)))

    return spoilt


def _positions(change):
    return _readings(
        lambda poses, rng: RigidTransform.from_components(change(poses.translation, rng), poses.rotation)
    )


def _scale(factor):
    return _positions(lambda places, rng: places * factor)


def _freeze(first, last=1.0):
    """Repeat the reading at share `first` until share `last`."""

    def freeze(poses, rng):
        index = np.arange(len(poses))
        start, stop = int(first * len(poses)), int(last * len(poses))
        index[start:stop] = start
        return poses[index]

    return _readings(freeze)


def _spikes(places, rng):
    towards = rng.standard_normal((len(places), 3))
    towards *= 30.0 / np.linalg.norm(towards, axis=1, keepdims=True)
    return places + towards * (rng.random((len(places), 1)) < 0.05)


def _drift(places, rng):
    towards = rng.standard_normal(3)
    towards *= 5.0 / np.linalg.norm(towards)
    return places + np.linspace(0.0, 1.0, len(places))[:, None] * towards


def _random_poses(poses, rng):
    n = len(poses)
    return RigidTransform.from_components(rng.uniform(-300, 300, (n, 3)), Rotation.random(n, rng=rng))


def _turn_mount(sweep, sensor, rng):
    turn, mounting = Rotation.from_euler("x", np.pi), sensor.sensor_from_image
    if isinstance(mounting, RigidTransform):
        turn = RigidTransform.from_rotation(turn)
    return replace(sensor, sensor_from_image=mounting * turn)


def _quaternions(wxyz):
    return _readings(
        lambda rotations, rng: Rotation.from_quat(
            rotations.as_quat(scalar_first=True) * wxyz, scalar_first=True
        )
    )


def _flips(rotations, rng):
    axis = rng.standard_normal((len(rotations), 3))
    axis *= np.pi / np.linalg.norm(axis, axis=1, keepdims=True)
    return rotations * Rotation.from_rotvec(axis * (rng.random((len(rotations), 1)) < 0.05))


def _heading_drift(sweep, sensor, rng):
    time_s = sensor.readings.time_s
    turn = Rotation.from_rotvec(np.outer(np.deg2rad(5.0) * (time_s - time_s[0]), [0, 0, 1]))
    return _readings(lambda rotations, _: turn * rotations)(sweep, sensor, rng)


FAULTS = {
    "tracker in metres": _scale(1e-3),
    "tracker in inches": _scale(1 / 25.4),
    "tracker frozen": _freeze(0.0),
    "tracker frozen in the middle fifth": _freeze(0.4, 0.6),
    "tracker without turns": _readings(lambda poses, rng: RigidTransform.from_translation(poses.translation)),
    "tracker matrices inverted": _readings(lambda poses, rng: poses.inv()),
    "tracker mount turned by 180 deg about x": _turn_mount,
    "tracker spikes of 30 mm": _positions(_spikes),
    "tracker noise of 3 mm": _positions(lambda places, rng: places + 3.0 * rng.standard_normal(places.shape)),
    "tracker drift of 5 mm": _positions(_drift),
    "tracker random": _readings(_random_poses),
    "orientation stored xyzw": _readings(
        lambda rotations, rng: Rotation.from_quat(rotations.as_quat(scalar_first=False), scalar_first=True)
    ),
    "orientation inverted": _readings(lambda rotations, rng: rotations.inv()),
    "orientation in a world upside down": _readings(lambda r, rng: Rotation.from_euler("x", np.pi) * r),
    "orientation mirrored": _quaternions([1.0, -1.0, -1.0, 1.0]),
    "orientation x of the other sign": _quaternions([1.0, -1.0, 1.0, 1.0]),
    "orientation random": _readings(lambda rotations, rng: Rotation.random(len(rotations), rng=rng)),
    "orientation spikes of 180 deg": _readings(_flips),
    "orientation constant": _freeze(0.0),
    "orientation mount turned by 180 deg about x": _turn_mount,
    "orientation heading drift of 5 deg/s": _heading_drift,
}
