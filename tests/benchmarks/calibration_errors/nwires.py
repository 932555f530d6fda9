"""N-wires: whether the phantom's stated place is held, turned or estimated as it deserves.

Phantoms, probes and motions differ from trial to trial; wires are drilled to a tenth of a millimetre, dots
are known less well across the image than along it, and the tracker's errors are white and wander. What
counts is how far pixels end from where they truly are in the sensor's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.plane import Solution
from calibration.points import ImagePoints
from calibration.registration import REGISTRATIONS, calibrate_registered
from calibration.wires import calibrate_wires
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.wires import WirePhantom

from .hand import misread, smooth
from .rows import Row, trials

OF_EACH = 40
CASES = {
    "stated well (0-0.3 mm, 0-0.3 degrees)": ((0.0, 0.3), (0.0, 0.3)),
    "turned (0-0.3 mm, 1-3 degrees)": ((0.0, 0.3), (1.0, 3.0)),
    "shifted and turned (1-3 mm, 1-3 degrees)": ((1.0, 3.0), (1.0, 3.0)),
}
"""Ranges of the stated place's error: mm, of the wires' middle, and degrees about it."""

WORSE = 1.2
"""Mean error of the chosen over that of the best of the three for each case."""


@dataclass(frozen=True)
class Trial:
    """A scan to be drawn, and how wrong the phantom's stated place is."""

    seed: int
    shift_mm: tuple[float, float]
    turn_deg: tuple[float, float]


@dataclass(frozen=True)
class Found:
    """True error of each registration, mm, NaN if refused, and which was chosen."""

    errors_mm: dict[str, float]
    chosen: str


def measure(share: float, first_seed: int) -> list[Row]:
    """A row for each way in which the stated place is wrong."""
    count = max(3, round(share * OF_EACH))
    cases = list(CASES.items())
    todo = [Trial(first_seed + k, *ranges) for _, ranges in cases for k in range(count)]
    found = trials(run, todo)
    return [row_of(case, found[k * count : (k + 1) * count]) for k, (case, _) in enumerate(cases)]


def row_of(case: str, found: list[Found]) -> Row:
    """Mean errors of the chosen and of each registration for all."""
    table = {name: np.array([one.errors_mm[name] for one in found]) for name in REGISTRATIONS}
    chosen = np.array([one.errors_mm[one.chosen] if one.chosen else np.nan for one in found])
    means = {name: float(np.nanmean(errors)) for name, errors in table.items()}
    refused = int(np.isnan(chosen).sum())
    mean, best = float(np.nanmean(chosen)), min(means.values())
    each = ", ".join(
        f"{name} {means[name]:.2f} ({sum(one.chosen == name for one in found)} chosen)" for name in means
    )
    text = f"chosen {mean:.2f} mm, worst {np.nanmax(chosen):.2f}; {each}; {refused} of {len(found)} refused"
    return Row(f"N-wires {case}", text, f"at most {WORSE} times the best", mean <= WORSE * best)


def run(trial: Trial) -> Found:
    """Calibrate with each registration, and with the chosen one."""
    points, stated, pixel_mm, truth, corners_px = simulate(trial)
    errors = {}
    for name in REGISTRATIONS:
        try:
            solution = calibrate_wires(points, stated, pixel_mm, registration=name)
        except InsufficientDataError:
            errors[name] = np.nan
            continue
        errors[name] = apart_mm(solution, truth, corners_px)
    try:
        chosen = calibrate_registered(points, stated, pixel_mm)[1].registration
    except InsufficientDataError:
        chosen = ""
    return Found(errors, chosen)


def apart_mm(solution: Solution, truth: np.ndarray, corners_px: np.ndarray) -> float:
    """Root mean square distance of an image's corners from where they truly are in the sensor's frame."""
    size = np.diag([*solution.chain.pixel_mm, 1.0, 1.0])
    step = solution.chain.sensor_from_image.as_matrix() @ size - truth
    flat = np.column_stack([corners_px, np.zeros(len(corners_px)), np.ones(len(corners_px))])
    return float(np.sqrt(np.mean(np.sum((flat @ step.T)[:, :3] ** 2, axis=1))))


def simulate(trial: Trial) -> tuple[ImagePoints, WirePhantom, np.ndarray, np.ndarray, np.ndarray]:
    """Dots of a scan, the phantom with its stated place, rough pixels, the true matrix, and the corners."""
    rng = np.random.default_rng([trial.seed, 3])
    ends, patterns = wires(rng)
    count, rate = int(rng.integers(60, 200)), float(rng.uniform(5.0, 15.0))
    time_s = np.arange(count) / rate
    width_mm, depth_mm = rng.uniform(38.0, 55.0), rng.uniform(45.0, 80.0)
    pixel = rng.uniform(0.07, 0.2, 2)
    phantom_from_image = over_phantom(rng, time_s, width_mm, depth_mm)
    world_from_phantom = RigidTransform.from_components(rng.uniform(-200, 200, 3), Rotation.random(rng=rng))
    mounting = RigidTransform.from_components(rng.uniform(-80.0, 80.0, 3), Rotation.random(rng=rng))
    poses = world_from_phantom * phantom_from_image * mounting.inv()
    drilled = ends + 0.1 * rng.uniform(-1.0, 1.0, ends.shape)
    seen_mm = np.stack([cut(drilled, phantom_from_image[k]) for k in range(count)])
    noise = rng.uniform(0.5, 1.5) * np.array([0.25, 0.1])
    pixels = (seen_mm + noise * rng.standard_normal(seen_mm.shape)) / pixel
    drift = (rng.uniform(0.0, 0.3), rng.uniform(0.0, 0.2), 5.0)
    readings = misread(rng, poses, time_s, (rng.uniform(0.05, 0.25), rng.uniform(0.02, 0.1)), drift)
    frame = np.repeat(np.arange(count), len(ends))
    points = ImagePoints(
        pixels.reshape(-1, 2), frame, readings[frame], np.tile(np.arange(len(ends)), count), time_s[frame]
    )
    middle = ends.reshape(-1, 3).mean(axis=0)
    shift, turn = (
        rng.uniform(*limits) * Rotation.random(rng=rng).apply([0.0, 0.0, 1.0])
        for limits in (trial.shift_mm, np.deg2rad(trial.turn_deg))
    )
    about = RigidTransform.from_translation(middle)
    wrong = about * RigidTransform.from_components(shift, Rotation.from_rotvec(turn)) * about.inv()
    names = tuple(f"w{k}" for k in range(len(ends)))
    stated = WirePhantom(names, ends, patterns, world_from_phantom * wrong)
    truth = mounting.as_matrix() @ np.diag([*pixel, 1.0, 1.0])
    far = np.array([width_mm, depth_mm]) / pixel
    corners = np.array([[0.0, 0.0], [far[0], 0.0], [0.0, far[1]], far])
    return points, stated, pixel * rng.uniform(0.97, 1.03), truth, corners


def wires(rng: np.random.Generator) -> tuple[np.ndarray, tuple[tuple[int, ...], ...]]:
    """Two to four layers of N in a box 40 mm long, none the mirror of itself; shape (k, 2, 3)."""
    layers = int(rng.integers(2, 5))
    ends = []
    for layer in range(layers):
        height = 5.0 + 10.0 * layer
        left, right = rng.uniform(0.0, 5.0), rng.uniform(25.0, 32.0)
        near, far = (left, right) if rng.random() < 0.5 else (right, left)
        inset = rng.uniform(0.05, 0.2) * (far - near)
        ends += [
            [[left, 0.0, height], [left, 40.0, height]],
            [[near + inset, 0.0, height], [far - inset, 40.0, height]],
            [[right, 0.0, height], [right, 40.0, height]],
        ]
    return np.array(ends), tuple((3 * k, 3 * k + 1, 3 * k + 2) for k in range(layers))


def over_phantom(
    rng: np.random.Generator, time_s: np.ndarray, width_mm: float, depth_mm: float
) -> RigidTransform:
    """Images about square to the wires, turned and shifted as a hand does, ``phantom_from_image``."""
    square = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).T)
    reach = np.deg2rad(rng.uniform([8.0, 5.0, 5.0], [30.0, 20.0, 25.0]))
    angles = np.column_stack([smooth(rng, time_s, one) for one in reach])
    turned = Rotation.from_rotvec(angles) * square
    centre = np.array([width_mm / 2.0, depth_mm / 2.0, 0.0])
    middle = np.column_stack(
        [
            16.0 + smooth(rng, time_s, rng.uniform(1.0, 5.0)),
            20.0 + smooth(rng, time_s, rng.uniform(5.0, 12.0)),
            18.0 + smooth(rng, time_s, rng.uniform(1.0, 6.0)),
        ]
    )
    return RigidTransform.from_components(middle - turned.apply(centre), turned)


def cut(ends: np.ndarray, phantom_from_image: RigidTransform) -> np.ndarray:
    """Where an image's plane cuts wires, mm across and down the image, shape (k, 2)."""
    image = phantom_from_image.inv()
    front, back = image.apply(ends[:, 0]), image.apply(ends[:, 1])
    share = front[:, 2] / (front[:, 2] - back[:, 2])
    return (front + share[:, None] * (back - front))[:, :2]
