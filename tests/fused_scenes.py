"""Hand sweeps, edges between their frames with the errors that images have, and sensors: poses only.

The errors are not those that the fusion assumes: the scale changes smoothly along the sweep, pairs share
errors of their frames.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.core.relative import RelativePoses
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.motion.trajectory import solve_trajectory
from speckle3d.motion.uncertainty import claimed_covariance
from speckle3d.simulation.movement import HandMotion, frame_times, hand_sweep
from speckle3d.simulation.sensors import (
    simulate_orientation,
    simulate_tracker,
)

CENTRE_MM = np.array([7.0, 16.0, 0.0])
REACH_MM = 0.7
TURN_PER_MM = np.deg2rad(0.1)


@dataclass(frozen=True)
class Scene:
    """One sweep, and what `fuse` is given of it."""

    truth: RigidTransform
    edges: RelativePoses
    image: RigidTransform
    covariance: FloatArray
    scale_sigma: float
    turn_sigma_per_mm: FloatArray
    time_s: FloatArray
    orientation: OrientationSensor
    tracker: Tracker

    def given(self):
        """First arguments of `fuse`."""
        return (
            self.edges,
            self.image,
            0.0,
            self.scale_sigma,
            0.0,
            self.turn_sigma_per_mm,
            CENTRE_MM,
            self.time_s,
        )


def scene(
    seed,
    frames=60,
    length_mm=5.0,
    scale_sigma=0.03,
    motion=None,
    noise=1.0,
):
    """A sweep of a hand at 25 frames/s, with a tracker and an orientation sensor."""
    rng = np.random.default_rng(seed)
    seconds = frames / 25.0
    start = RigidTransform.from_translation(np.zeros(3))
    world = RigidTransform.from_components(rng.uniform(-200, 200, 3), Rotation.random(rng=rng))
    path = hand_sweep(length_mm, seconds, 14.0, motion or HandMotion(), start, world, rng)
    times = frame_times(frames, 25.0, rng)
    truth = path.world_from_image(times)
    edges = _edges(truth, scale_sigma, rng)
    found = solve_trajectory(edges, frames, CENTRE_MM, with_covariance=True)
    turn = np.full(2, TURN_PER_MM)
    shared = SharedErrors(scale_sigma, 0.0, turn)
    covariance = claimed_covariance(found.poses, found.covariance, CENTRE_MM, shared, 0.0)
    span = (-0.3, seconds + 0.3)
    return Scene(
        truth,
        edges,
        found.poses,
        covariance,
        scale_sigma,
        turn,
        times,
        simulate_orientation(path, span, rng),
        simulate_tracker(path, span, rng, noise),
    )


def _edges(truth, scale_sigma, rng):
    centre = RigidTransform.from_translation(CENTRE_MM)
    about = centre.inv() * (truth[0].inv() * truth) * centre
    z = about.translation[:, 2]
    n = len(z)
    apart = [(i, j) for j in range(1, n) for i in range(max(0, j - 8), j)]
    first, second = np.array([(i, j) for i, j in apart if j - i == 1 or abs(z[j] - z[i]) < REACH_MM]).T
    relative = about[first].inv() * about[second]
    phase = rng.uniform(0, 2 * np.pi, 3)
    # What tissue changes: a smooth part of the scale, with periods of 3 to 5 mm of a like size to the whole.
    uneven = 0.5 * np.sqrt(2.0) * np.sin(2 * np.pi * z / rng.uniform(3, 5) + phase[0])
    scale = np.exp(scale_sigma * (rng.standard_normal() + uneven[second]))
    rate = TURN_PER_MM * rng.standard_normal(2)
    sigma = np.array([2e-3, 2e-3, 0.0, 3e-3, 3e-3, 2e-4])
    step = relative.translation.copy()
    distance = step[:, 2] / scale
    sigma_z = 0.01 + 0.04 * np.abs(distance)
    of_frame = rng.standard_normal((n, 6))
    noise = 0.7 * rng.standard_normal((first.size, 6)) + 0.5 * (of_frame[second] - of_frame[first])
    step[:, 2] = distance + sigma_z * noise[:, 2]
    step[:, :2] += sigma[:2] * noise[:, :2]
    turn = relative.rotation.as_rotvec()
    turn[:, :2] += distance[:, None] * rate + sigma[3:5] * noise[:, 3:5]
    turn[:, 2] += sigma[5] * noise[:, 5]
    deviation = np.tile(sigma, (first.size, 1))
    deviation[:, 2] = sigma_z
    covariance = np.apply_along_axis(np.diag, 1, deviation**2)
    return RelativePoses(
        first, second, RigidTransform.from_components(step, Rotation.from_rotvec(turn)), covariance
    )


def errors(poses, truth):
    """(x, y, z, tilt, yaw, roll) of the last frame against the first, mm and rad."""
    found, true = poses[0].inv() * poses[-1], truth[0].inv() * truth[-1]
    turn = (found.rotation * true.rotation.inv()).as_rotvec()
    return np.concatenate([found.apply(CENTRE_MM) - true.apply(CENTRE_MM), turn])
