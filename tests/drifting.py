"""Hand-like sweeps, their drifting image-based reconstruction, and a jittery tracker: poses only."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.geometry import relative_poses, rotation_from_fixed_angles

CENTRE_MM = np.array([19.0, 20.0, 0.0])
CORNERS_MM = np.array([[0.0, 0.0, 0.0], [38.0, 0.0, 0.0], [38.0, 40.0, 0.0], [0.0, 40.0, 0.0]])


def wobble(rng, frames, amplitude, slowest=1.0, fastest=6.0):
    """Sum of a few sines over the sweep; its standard deviation is about `amplitude`."""
    t = np.linspace(0.0, 1.0, frames)
    cycles, phase = rng.uniform(slowest, fastest, 4), rng.uniform(0.0, 2.0 * np.pi, 4)
    return amplitude * np.sin(2.0 * np.pi * cycles * t[:, None] + phase).sum(axis=1) / np.sqrt(2.0)


def hand_sweep(rng, frames=200, length_mm=20.0, turns=0):
    """True ``world_from_image``: uneven speed, 0.3 mm and 0.5 degrees of wobble, `turns` reversals."""
    speed = np.clip(1.0 + wobble(rng, frames, 0.25), 0.1, None)
    travel = np.concatenate([[0.0], np.cumsum(speed[1:])])
    travel *= (turns + 1) / travel[-1]
    leg = np.floor(travel).astype(int)
    z = length_mm * np.where(leg % 2 == 0, travel - leg, 1.0 - travel + leg)
    z[-1] = length_mm * ((turns + 1) % 2)
    position = np.stack([wobble(rng, frames, 0.3), wobble(rng, frames, 0.3), z], axis=1)
    roll, yaw, tilt = (np.deg2rad(wobble(rng, frames, 0.5)) for _ in range(3))
    about_centre = RigidTransform.from_components(position, rotation_from_fixed_angles(roll, yaw, tilt))
    local = about_centre * RigidTransform.from_translation(-CENTRE_MM)
    world = RigidTransform.from_components(rng.uniform(-300.0, 300.0, 3), Rotation.random(rng=rng))
    return world * local


def accumulate(first_from_steps):
    """Chain relative poses from the identity."""
    matrices = [np.eye(4)]
    for step in first_from_steps.as_matrix():
        matrices.append(matrices[-1] @ step)
    return RigidTransform.from_matrix(np.array(matrices))


def drifting_poses(truth, rng):
    """Image-based poses: elevational steps too long by 15 %, tilt that drifts by 1.5 degrees per 20 mm.

    Both drifts vary by a third along the sweep and follow the signed distance travelled.
    """
    steps = relative_poses(truth)
    n = len(steps)
    at_centre = steps.apply(CENTRE_MM) - CENTRE_MM
    uneven = 1.0 + wobble(rng, n, 1.0 / 3.0, 0.3, 1.2)
    shift = at_centre + rng.normal(0.0, 0.005, (n, 3))
    shift[:, 2] += 0.15 * uneven * at_centre[:, 2]
    angles = np.deg2rad(rng.normal(0.0, 0.01, (n, 3)))
    angles[:, 0] += np.deg2rad(1.5) / 20.0 * uneven * at_centre[:, 2]
    rotation = steps.rotation * rotation_from_fixed_angles(angles[:, 2], angles[:, 1], angles[:, 0])
    about_centre = RigidTransform.from_components(CENTRE_MM + shift, rotation)
    return accumulate(about_centre * RigidTransform.from_translation(-CENTRE_MM))


def tracker_poses(truth, rng, outliers=0.0):
    """Tracker readings: noise of 0.15 mm and 0.1 degrees per axis, a share of poses off by 2 mm."""
    n = len(truth)
    offset = rng.normal(0.0, 0.15, (n, 3))
    direction = rng.normal(size=(n, 3))
    direction *= 2.0 / np.linalg.norm(direction, axis=1, keepdims=True)
    offset += np.where(rng.uniform(size=(n, 1)) < outliers, direction, 0.0)
    turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, 0.1, (n, 3))))
    return truth * RigidTransform.from_components(offset, turn)
