"""Orientation sensors: wrong minima over set-ups at random, and whether claimed errors are true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.orientation import calibrate_orientation
from calibration.points import ImagePoints
from speckle3d.core.errors import InsufficientDataError

from .hand import smooth, wander
from .rows import Row, coverage_row, trials

ODD, HELD = 5000, 150
DOWN = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""An image that looks straight down in a world whose z axis is up."""


@dataclass(frozen=True)
class Trial:
    """A scan to be drawn.

    Attributes
    ----------
    odd : bool
        Beams from level to vertical, a plane up to 12 degrees off level; else a floor scanned from above.
    wander_deg, wander_s : float
        Of the inclination, each axis.
    """

    seed: int
    odd: bool
    wander_deg: float = 0.0
    wander_s: float = 10.0


@dataclass(frozen=True)
class Judged:
    """What a trial ended with: angle wrong and claimed; errors over claims; or why it was refused."""

    below_level_deg: float
    wrong_deg: float = 0.0
    claimed_deg: float = 0.0
    scores: tuple[float, ...] = ()
    refused: str = ""


def scan(trial: Trial) -> tuple[np.ndarray, Rotation, Rotation, np.ndarray, Rotation]:
    """Directions of lines (square pixels), the sensor's readings, the mounting, times and true images."""
    rng = np.random.default_rng([trial.seed, 2008])
    axes = np.eye(3)
    count, rate = int(rng.integers(40, 240)), float(rng.uniform(4.0, 12.0))
    time_s = np.arange(count) / rate
    if trial.odd:
        reaches = rng.uniform([12.0, 8.0, 0.0], [30.0, 25.0, 60.0])
        lean = Rotation.from_rotvec(np.deg2rad(rng.uniform(0.0, 90.0)) * axes[0])
        slope = Rotation.from_rotvec(np.deg2rad(rng.uniform(0, 12)) * _level(rng))
    else:
        reaches = rng.uniform([15.0, 8.0, 10.0], [30.0, 20.0, 60.0])
        lean, slope = Rotation.identity(), Rotation.from_rotvec(np.deg2rad(rng.uniform(0, 3)) * _level(rng))
    tilt, roll, yaw = (
        Rotation.from_rotvec(np.outer(np.deg2rad(smooth(rng, time_s, reach)), axes[k]))
        for k, reach in zip((0, 2, 2), reaches, strict=True)
    )
    images = yaw * DOWN * lean * roll * tilt
    normal = images.inv().apply(slope.apply(axes[2]))
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    along *= np.sign(along[:, :1])
    found = np.arctan2(along[:, 1], along[:, 0]) + np.deg2rad(0.12) * rng.standard_normal(count)
    directions = np.column_stack([np.cos(found), np.sin(found)])
    moving = trial.wander_deg * wander(rng, time_s, trial.wander_s, 3) * [1.0, 1.0, 4.0]
    moving += 0.1 * rng.standard_normal((count, 3))
    mounting = Rotation.random(rng=rng)
    heading = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axes[2])
    readings = Rotation.from_rotvec(np.deg2rad(moving)) * heading * images * mounting.inv()
    return directions, readings, mounting, time_s, images


def judged(trial: Trial) -> Judged:
    """Calibrate a scan and hold the answer against the truth."""
    directions, readings, mounting, time_s, images = scan(trial)
    below = float(np.rad2deg(np.arcsin(np.clip(-images.as_matrix()[:, 2, 1].mean(), -1.0, 1.0))))
    poses = RigidTransform.from_rotation(readings)
    lines = ImagePoints(directions, np.arange(len(directions)), poses, time_s=time_s)
    try:
        solution = calibrate_orientation(lines, np.ones(2))
    except InsufficientDataError as error:
        return Judged(below, refused=str(error))
    step = (solution.chain.sensor_from_image.rotation.inv() * mounting).as_rotvec()
    covariance = solution.image_covariance(("gamma", "beta", "alpha"))
    claims = np.sqrt(np.diag(covariance))
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    wrong = float(np.rad2deg(np.linalg.norm(step)))
    return Judged(below, wrong, float(np.rad2deg(worst)), tuple((step[[0, 1, 2]] / claims).tolist()))


def _level(rng: np.random.Generator) -> np.ndarray:
    around = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(around), np.sin(around), 0.0])


def measure(share: float, first_seed: int) -> list[Row]:
    """Wrong minima of 5,000 set-ups; coverage for three kinds of wandering."""
    todo = [Trial(first_seed + n, True) for n in range(max(10, round(ODD * share)))]
    found = trials(judged, todo)
    accepted = [one for one in found if not one.refused]
    wrong = [one for one in accepted if one.wrong_deg > 3.0 * one.claimed_deg]
    far = [one for one in wrong if one.wrong_deg > 10.0]
    rows = [
        Row(
            "orientation, random set-ups, wrong by over 3 claimed errors",
            f"{len(wrong)} of {len(accepted)}, {len(far)} by over 10 degrees",
            "0",
            not wrong,
        )
    ]
    refused = [one for one in found if one.refused]
    steep = [one for one in refused if one.below_level_deg > LEVEL_DEG]
    part = 100.0 * len(refused) / len(found)
    rows.append(
        Row(
            "orientation, random set-ups refused",
            f"{part:.1f} %, {len(steep)} with beams over {LEVEL_DEG:g} degrees below level",
            "<= 20 %, near level only",
            part <= 20.0 and not steep,
        )
    )
    for degrees, seconds in ((0.25, 10.0), (0.15, 40.0), (0.0, 10.0)):
        held = [Trial(first_seed + n, False, degrees, seconds) for n in range(max(10, round(HELD * share)))]
        good = [one for one in trials(judged, held) if not one.refused]
        scores = np.array([one.scores for one in good])
        row = coverage_row(
            f"orientation, wander {degrees:g} deg, {seconds:g} s", scores, np.ones_like(scores)
        )
        tilt = np.sqrt(np.mean([one.wrong_deg**2 for one in good]))
        refusals = len(held) - len(good)
        more = f"{row.found}, RMS {tilt:.2f} degrees, {refusals} refused"
        rows.append(Row(row.case, more, row.target, row.reached))
    return rows


LEVEL_DEG = 25.0
"""Beams nearer to level than this may be refused: gravity hardly tells them from their mirror."""
