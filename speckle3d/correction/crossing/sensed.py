"""Orientation by a sensor: it replaces the images' slow turns, and tells how the sweeps lie to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.crossing.path import StraightSweep
from speckle3d.correction.crossing.sweep import CrossingSweep

INCLINATION_RAD, HEADING_RAD = np.deg2rad([0.15, 0.5])
"""How far a sensor's slow errors change over a sweep, standard deviation: about horizontal axes and about the
vertical."""
_BETWEEN_INCLINATION_RAD, _BETWEEN_HEADING_RAD = np.deg2rad([1.0, 8.0])
"""The same between two sweeps: minutes apart, the probe, and its iron, turned in the earth's field."""
_ORDER = 3


def turned(sweep: CrossingSweep) -> CrossingSweep:
    """Give the poses the sensed orientation: slow tilt and yaw are the sensor's, the rest the images'.

    Steps stay as they are along each image's axes.
    """
    if sweep.sensed is None:
        return sweep
    images = sweep.poses.rotation
    centred = sweep.poses * RigidTransform.from_translation(sweep.centre_mm)
    steps = (centred[:-1].inv() * centred[1:]).translation
    travel = np.concatenate([[0.0], np.cumsum(np.abs(steps[:, 2]))])
    to_world = (sweep.sensed * images.inv()).mean()
    away = (images.inv() * to_world.inv() * sweep.sensed).as_rotvec()
    basis = legendre.legvander(2.0 * travel / max(float(travel[-1]), 1e-6) - 1.0, _ORDER)
    good = sweep.good
    smooth = basis @ np.linalg.lstsq(basis[good], away[good], rcond=None)[0]
    # Roll is the images': they see it directly.
    smooth[:, 2] = smooth[:, 2].mean()
    rotation = to_world * images * Rotation.from_rotvec(smooth)
    centres = np.concatenate([np.zeros((1, 3)), np.cumsum(rotation[:-1].apply(steps), axis=0)])
    poses = RigidTransform.from_components(centres, rotation)
    return replace(sweep, poses=poses * RigidTransform.from_translation(-sweep.centre_mm))


def slow_error_per_mm(sweep: CrossingSweep, length_mm: float) -> FloatArray:
    """Standard deviation of the sensed tilt's and yaw's drift, rad/mm, (2,); infinite without a sensor."""
    if sweep.sensed is None:
        return np.full(2, np.inf)
    up = sweep.sensed.inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
    share = (up / np.linalg.norm(up))[:2] ** 2
    over = np.sqrt(INCLINATION_RAD**2 * (1.0 - share) + HEADING_RAD**2 * share)
    # A drift from -1 to 1 along the sweep has a standard deviation of 1 / sqrt(3).
    return np.asarray(2.0 * np.sqrt(3.0) * over / length_mm)


def relative_turn(
    first: CrossingSweep, second: CrossingSweep, straight: Sequence[StraightSweep]
) -> tuple[Rotation | None, FloatArray]:
    """Turn of the second path against the first by both sensors, and the information of its error."""
    if first.sensed is None or second.sensed is None:
        return None, np.zeros((3, 3))
    worlds = [
        (sweep.sensed * path.frames.rotation.inv()).mean()
        for sweep, path in zip((first, second), straight, strict=True)
        if sweep.sensed is not None
    ]
    up = worlds[0].inv().apply([0.0, 0.0, 1.0])
    vertical = np.outer(up, up)
    information = vertical / _BETWEEN_HEADING_RAD**2 + (np.eye(3) - vertical) / _BETWEEN_INCLINATION_RAD**2
    return worlds[0].inv() * worlds[1], information
