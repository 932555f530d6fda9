"""What may be wrong with a sensor's stream, each put right: the suspects when a sensor is contradicted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import OrientationSensor, Tracker

Sensor = TypeVar("Sensor", OrientationSensor, Tracker)

_UNITS_MM = {"metres": 1e3, "inches": 25.4, "centimetres": 10.0}
_MIRRORS = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "z": (1.0, 1.0, -1.0)}


@dataclass(frozen=True)
class Suspect(Generic[Sensor]):
    """A fault, and the sensor as it would be without it."""

    name: str
    mended: Sensor


def suspects(sensor: Sensor) -> Iterator[Suspect[Sensor]]:
    """Faults of a stream that a convention explains; clocks and mountings have values to be searched for."""
    assert sensor.sensor_from_image is not None
    yield Suspect("mounting inverted", replace(sensor, sensor_from_image=sensor.sensor_from_image.inv()))
    samples = sensor.readings.world_from_sensor
    for name, other in _poses(samples) if isinstance(samples, RigidTransform) else _rotations(samples):
        yield Suspect(name, replace(sensor, readings=replace(sensor.readings, world_from_sensor=other)))


def _poses(poses: RigidTransform) -> Iterator[tuple[str, RigidTransform]]:
    moved, turned = poses.as_components()
    for name, factor in _UNITS_MM.items():
        yield f"units: {name} for millimetres", RigidTransform.from_components(factor * moved, turned)
    yield "matrices inverted", poses.inv()
    yield "rotations transposed", RigidTransform.from_components(moved, turned.inv())
    for axis, signs in _MIRRORS.items():
        flip = np.diag([*signs, 1.0])
        yield f"handedness: {axis} mirrored", RigidTransform.from_matrix(flip @ poses.as_matrix() @ flip)
        flipped = RigidTransform.from_components(moved * signs, turned)
        yield f"handedness: {axis} of the positions mirrored", flipped


def _rotations(turned: Rotation) -> Iterator[tuple[str, Rotation]]:
    xyzw = turned.as_quat()
    yield "quaternions stored xyzw for wxyz", Rotation.from_quat(xyzw[:, [3, 0, 1, 2]])
    yield "quaternions wxyz taken for xyzw", Rotation.from_quat(xyzw[:, [1, 2, 3, 0]])
    yield "quaternions inverted", turned.inv()
    for axis, signs in _MIRRORS.items():
        flip = np.diag(signs)
        yield f"handedness: {axis} mirrored", Rotation.from_matrix(flip @ turned.as_matrix() @ flip)
