"""Pairs of sweeps over one piece of tissue, cheap to make, with poses that drift.

Tissue is random scatterers on a fine grid, their strengths made of layers, septa, vessels and patches. An
image sums them over a beam that is thicker in elevation than across, most so away from its focus, as
complex amplitudes, so that speckle and its change with the view come out by themselves. Shadows follow the
probe, gain differs between the sweeps, part of the speckle is each sweep's own, and tissue may move in
between. Poses drift by errors that vary along the sweep as random walks do: nothing here is a polynomial.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, gaussian_filter1d, zoom
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.simulation.movement import hand_sweep
from speckle3d.simulation.settings import SimulationSettings

CELL_MM = 0.25
"""Side of a cell with one scatterer."""
SPACE_MM = np.array([46.0, 34.0, 46.0])
LOW_MM = np.array([-23.0, -2.0, -23.0])
GRID = ImageGrid(96, 82, 0.3, 0.35, 0.2)
FRAME_RATE_HZ = 25.0


INDEPENDENT = 0.3
"""Share of the speckle's power that the sweeps do not share."""
STRETCH, VARIATION = 0.08, 0.03
"""Standard deviations of the scale's logarithm: wrong in both sweeps together; in each and along it."""
TURN_PER_MM = 0.002
"""Standard deviation of false tilt and yaw, rad/mm."""


@dataclass(frozen=True)
class PairCase:
    """What is made.

    Attributes
    ----------
    texture : float
        Factor on the contrast of everything in the tissue; 1 is usual, 0.3 poor.
    moved_mm : float
        RMS displacement of the tissue between the sweeps, smooth over 8 mm.
    """

    seed: int
    angle_deg: float = 90.0
    length_mm: float = 24.0
    frames: int = 150
    texture: float = 1.0
    moved_mm: float = 0.0
    with_sensor: bool = False
    mirror: bool = False


@dataclass(frozen=True)
class TissuePair:
    """Two sweeps with their true poses in the tissue."""

    first: CrossingSweep
    second: CrossingSweep
    truth: tuple[RigidTransform, RigidTransform]


def tissue_pair(case):
    """Make the two sweeps of a case."""
    rng = np.random.default_rng([case.seed, 611])
    strength = _strength(case, rng)
    common = rng.standard_normal((2, *strength.shape), np.float32)
    common_stretch = STRETCH * rng.standard_normal()
    displacement = _displacement_field(rng, case.moved_mm)
    heading = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    # The medium's y points down, the sensor's z up.
    world = heading * Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    sign = rng.choice([-1.0, 1.0])
    sweeps, truths = [], []
    for number in (0, 1):
        truth = _hand(case, rng, number, sign * case.angle_deg)
        fresh = rng.standard_normal(common.shape, np.float32)
        weight = np.float32(np.sqrt([1 - INDEPENDENT, INDEPENDENT]))
        field = strength * (weight[0] * common + weight[1] * fresh)
        stack = _images(field, truth, displacement if number else 0.0 * displacement, rng)
        poses = _drifting_poses(truth, common_stretch, rng)
        if case.mirror and number:
            flip = np.diag([1.0, 1.0, -1.0, 1.0])
            poses = RigidTransform.from_matrix(flip @ poses.as_matrix() @ flip)
        sensor = None
        if case.with_sensor:
            sensor = world * truth.rotation * _slow_errors(len(truth), rng, world, truth)
        name = ("first", "second")[number]
        sweeps.append(CrossingSweep(name, stack, poses, GRID.centre_mm, 0.08, 0.002, sensor))
        truths.append(truth)
    return TissuePair(*sweeps, tuple(truths))


def _strength(case, rng):
    """Strength of the scatterers on the fine grid, made at twice its cells."""
    shape = tuple(np.round(SPACE_MM / (2 * CELL_MM)).astype(int))
    x, y, z = np.meshgrid(
        *(low + (np.arange(n) + 0.5) * 2 * CELL_MM for low, n in zip(LOW_MM, shape, strict=True)),
        indexing="ij",
    )
    # Patches of two sizes, in decibels.
    level = _smooth_noise(rng, shape, 1.0) * 2.5 + _smooth_noise(rng, shape, 2.5) * 2.5
    depth = rng.uniform(1.5, 4.0)
    while depth < 30.0:
        surface = depth + 1.2 * _smooth_noise(rng, (shape[0], 1, shape[2]), 6.0)
        level += rng.normal(0.0, 5.0) * (y > surface)
        level += rng.uniform(0.0, 8.0) * np.exp(-0.5 * ((y - surface) / 0.4) ** 2)
        depth += rng.uniform(3.0, 9.0)
    places = np.stack([x, y, z], axis=-1).astype(np.float32)
    for _ in range(rng.integers(3, 8)):
        # Vessels: tubes that wander, in any direction along the skin or aslant.
        along = rng.normal(size=3) * [1.0, 0.4, 1.0]
        along = (along / np.linalg.norm(along)).astype(np.float32)
        through = np.array([rng.uniform(-11, 11), rng.uniform(4, 26), rng.uniform(-11, 11)], np.float32)
        bend = np.cross(along, rng.normal(size=3)).astype(np.float32)
        away = places - through
        t = away @ along
        away -= t[..., None] * along + np.sin(t / np.float32(rng.uniform(5, 12)))[..., None] * bend
        level -= rng.uniform(8, 20) * ((away**2).sum(axis=-1) < rng.uniform(0.7, 2.2) ** 2)
    return zoom(
        (10 ** (case.texture * level / 20.0)).astype(np.float32), 2, order=1, grid_mode=True, mode="nearest"
    )


def _smooth_noise(rng, shape, sigma_mm):
    noise = rng.standard_normal(shape).astype(np.float32)
    noise = gaussian_filter(noise, sigma_mm / (2 * CELL_MM), truncate=2.5, mode="wrap")
    return noise / noise.std()


def _displacement_field(rng, rms_mm):
    """Displacement of the tissue on a grid of 1 mm, shape (3, x, y, z); no shift nor turn of the whole."""
    shape = tuple(np.round(SPACE_MM).astype(int) + 1)
    field = np.stack([gaussian_filter(rng.standard_normal(shape), 8.0 / np.sqrt(2.0)) for _ in range(3)])
    places = (
        np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=0)
        - np.array(shape)[:, None, None, None] / 2
    )
    rows = [np.concatenate([np.eye(3), np.cross(np.eye(3), p)]) for p in places.reshape(3, -1).T[::7]]
    values = field.reshape(3, -1).T[::7]
    rigid = np.linalg.lstsq(np.concatenate([r.T for r in rows]), values.ravel(), rcond=None)[0]
    field -= rigid[:3, None, None, None] + np.cross(rigid[3:], places, axisb=0, axisc=0)
    return rms_mm * field / np.sqrt((field**2).mean())


def _hand(case, rng, number, angle_deg):
    """True poses of the frames: the second sweep starts turned about the middle, off it by a few mm."""
    duration = case.frames / FRAME_RATE_HZ
    middle = np.array([GRID.width_mm / 2, 0.0, case.length_mm / 2])
    turn = Rotation.from_euler("y", angle_deg * number + rng.normal(0, 3.0), degrees=True)
    off = rng.normal(0.0, [1.5, 0.3, 1.5]) * number
    lean = Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, [3.0, 0.0, 3.0])) * number)
    start = RigidTransform.from_components(off, lean * turn) * RigidTransform.from_translation(-middle)
    settings = SimulationSettings(length_mm=case.length_mm)
    path = hand_sweep(settings, duration, GRID.width_mm, RigidTransform.identity(), rng)
    return start * path.medium_from_image(np.arange(case.frames) / FRAME_RATE_HZ)


def _drifting_poses(truth, stretch, rng):
    """Poses as images give them: steps about the centre with errors, chained."""
    at_centre = truth * RigidTransform.from_translation(GRID.centre_mm)
    steps = at_centre[:-1].inv() * at_centre[1:]
    shift, turns = steps.translation.copy(), steps.rotation.as_rotvec()
    n, dz = len(shift), np.abs(shift[:, 2]).mean()
    log_scale = stretch + VARIATION * rng.standard_normal() + VARIATION * _walk(rng, n, 8.0 / dz)
    scale = np.exp(-(log_scale + 0.10 * rng.standard_normal(n)))
    for axis in (0, 1):
        rate = TURN_PER_MM * (rng.standard_normal() + 0.5 * _walk(rng, n, 10.0 / dz))
        turns[:, axis] -= rate * shift[:, 2] + 2e-4 * rng.standard_normal(n)
    shift[:, 2] *= scale
    shift[:, :2] += 0.002 * rng.standard_normal((n, 2))
    turns[:, 2] += 3e-5 * rng.standard_normal(n)
    poses, chain = [RigidTransform.identity()], RigidTransform.identity()
    for step in RigidTransform.from_components(shift, Rotation.from_rotvec(turns)):
        chain = chain * step
        poses.append(chain)
    whole = RigidTransform.concatenate(poses)
    about = RigidTransform.from_translation(GRID.centre_mm)
    return about * whole * about.inv()


def _walk(rng, n, length):
    """Unit noise that forgets over so many steps."""
    noise = gaussian_filter1d(rng.standard_normal(n + 400), max(length, 1.0) / 2.0)[200 : 200 + n]
    return noise / (np.sqrt(1.0 / (2.0 * np.sqrt(np.pi) * max(length, 1.0) / 2.0)))


def _slow_errors(n, rng, world, truth):
    """Errors of a sensor in the image's frame: they wander over the sweep."""
    length = n / 2.0
    around = np.stack([np.deg2rad(s) * _walk(rng, n, length) for s in (0.15, 0.15, 0.5)], axis=1)
    around += np.deg2rad([0.3, 0.3, 3.0]) * rng.standard_normal(3)
    around += np.deg2rad(0.05) * rng.standard_normal((n, 3))
    inside = (world * truth.rotation).inv().apply(around)
    return Rotation.from_rotvec(inside)


def _images(field, truth, displacement, rng):
    """Images as log-compressed stack."""
    stack = ImageStack(GRID)
    poses = truth.as_matrix()[:, :3]
    n = len(poses)
    amplitude = np.empty((2, GRID.vectors, 2 * GRID.samples), np.float32)
    focus = rng.uniform(14.0, 22.0)
    level = np.array([0.0, 0.0])
    shade = gaussian_filter(rng.standard_normal((n + 100, GRID.vectors + 40)), [30, 6])[50:-50, 20:-20]
    shade = 2.5 * shade / shade.std() - 9.0 * np.maximum(shade / shade.std() - 1.3, 0.0)
    tilt_db = rng.normal(0.0, 0.25)
    depth = GRID.first_sample_depth_mm + np.arange(GRID.samples) * GRID.sample_spacing_mm
    gain = 10 ** ((shade[:, :, None] + tilt_db * depth + rng.normal(0, 4.0)) / 10.0)
    noise = 10 ** (-2.2 + 0.05 * (depth - 20.0))
    small = displacement.astype(np.float32)
    for number, pose in enumerate(poses):
        _echo(field, pose, small, focus, amplitude)
        intensity = (amplitude**2).sum(axis=0).reshape(GRID.vectors, GRID.samples, 2).mean(axis=2)
        if number == 0:
            level = np.median(intensity)
        hiss = level * noise * rng.exponential(1.0, intensity.shape)
        stack.keep(number, (gain[number] * intensity + hiss).astype(np.float32))
    return stack


@njit(cache=True, fastmath=True)
def _echo(field, pose, displacement, focus_mm, out):  # pragma: no cover
    """Sum scatterers about every point of an image over the beam."""
    vectors, samples = out.shape[1], out.shape[2]
    nx, ny, nz = field.shape[1:]
    mx, my, mz = displacement.shape[1:]
    for j in range(samples):
        y = 0.2 + (j / 2.0 - 0.25) * 0.35
        away = (y - focus_mm) / 10.0
        thick = 0.40 * np.sqrt(1.0 + away * away)
        wide = 0.22 * np.sqrt(1.0 + 0.3 * away * away)
        for i in range(vectors):
            x = i * 0.3
            real = imaginary = 0.0
            p0 = pose[0, 0] * x + pose[0, 1] * y + pose[0, 3]
            p1 = pose[1, 0] * x + pose[1, 1] * y + pose[1, 3]
            p2 = pose[2, 0] * x + pose[2, 1] * y + pose[2, 3]
            m0 = min(max(int(p0 + 23.5), 0), mx - 1)
            m1 = min(max(int(p1 + 2.5), 0), my - 1)
            m2 = min(max(int(p2 + 23.5), 0), mz - 1)
            p0 += displacement[0, m0, m1, m2]
            p1 += displacement[1, m0, m1, m2]
            p2 += displacement[2, m0, m1, m2]
            for a in range(-3, 4):
                ez = a * 0.75 * thick
                wz = np.exp(-0.5 * (ez / thick) ** 2)
                for b in range(-2, 3):
                    ex = b * 0.9 * wide
                    w = wz * np.exp(-0.5 * (ex / wide) ** 2)
                    q0 = p0 + pose[0, 0] * ex + pose[0, 2] * ez
                    q1 = p1 + pose[1, 0] * ex + pose[1, 2] * ez
                    q2 = p2 + pose[2, 0] * ex + pose[2, 2] * ez
                    k0 = int((q0 + 23.0) * 4.0)
                    k1 = int((q1 + 2.0) * 4.0)
                    k2 = int((q2 + 23.0) * 4.0)
                    if 0 <= k0 < nx and 0 <= k1 < ny and 0 <= k2 < nz:
                        real += w * field[0, k0, k1, k2]
                        imaginary += w * field[1, k0, k1, k2]
            out[0, i, j] = real
            out[1, i, j] = imaginary
