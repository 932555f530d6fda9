"""Motions that are missing, and good scans: what is accepted, how wrong it is, what is named.

The hand moves smoothly: each motion is a sum of slow sinusoids, all at once or one after the other. Probes,
mountings, floors, frame rates, numbers of frames, noise and drop-outs differ from scan to scan.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.motion import MOTIONS
from calibration.orientation import OrientationFit, calibrate_orientation
from calibration.plane import PlaneFit, calibrate_plane
from calibration.points import ImagePoints
from calibration.wires import calibrate_cross_wire
from speckle3d.core.errors import InsufficientDataError

from .hand import wander
from .rows import Row, trials

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from calibration_examples import BEAM_DOWN, about

WOBBLE_DEG, WOBBLE_MM = 1.0, 2.0
"""What a hand does that means to hold still."""

WRONG_MM, WRONG_DEG = 5.0, 5.0

MISSING = {
    "constant depth": ("depth",),
    "no tilt": ("tilt",),
    "no roll": ("roll",),
    "yaw only": ("tilt", "roll", "depth"),
}
WORDS = dict(zip(("tilt", "yaw", "roll", "sideways", "depth"), MOTIONS, strict=True))
DRIFT_S = 5.0


@dataclass(frozen=True)
class Scan:
    """A probe over a floor, what its images and its tracker say, and the truth.

    Attributes
    ----------
    ends_px : ndarray, shape (n, 2, 2)
        Two points of the line in each frame.
    size_mm : ndarray, shape (2,)
        Width and depth of the image.
    given_mm : ndarray, shape (2,)
        Pixel size as the scanner's calipers have it.
    """

    ends_px: np.ndarray
    readings: RigidTransform
    mounting: RigidTransform
    pixel_mm: np.ndarray
    given_mm: np.ndarray
    size_mm: np.ndarray
    time_s: np.ndarray

    @property
    def lines(self) -> ImagePoints:
        return ImagePoints.of_lines(np.arange(len(self.ends_px)), self.ends_px, self.readings, self.time_s)

    def error(self, solution) -> tuple[float, float]:
        """Worst of the image's corners, mm, and the rotation, degrees."""
        chain = solution.chain
        corners = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]]) * self.size_mm / self.pixel_mm
        found = chain.sensor_from_image.apply(np.column_stack([corners * chain.pixel_mm, np.zeros(4)]))
        truth = self.mounting.apply(np.column_stack([corners * self.pixel_mm, np.zeros(4)]))
        turn = (self.mounting.rotation.inv() * chain.sensor_from_image.rotation).magnitude()
        return float(np.linalg.norm(found - truth, axis=1).max()), float(np.rad2deg(turn))


def by_hand(rng, time_s: np.ndarray, reach: float) -> np.ndarray:
    """To and fro as far as `reach`, in 3 to 10 s, now slower and now faster, now wider and now less wide."""

    def slowly(periods: int) -> np.ndarray:
        waves = time_s[:, None] / rng.uniform(8.0, 30.0, periods) + rng.random(periods)
        return np.sin(2 * np.pi * waves).mean(axis=1)

    phase = 2 * np.pi * (time_s / rng.uniform(3.0, 10.0) + rng.random()) + 2.0 * slowly(3)
    moved = np.sin(phase) * (1.0 + 0.4 * slowly(3))
    return reach * moved / np.abs(moved).max()


def moves_of(rng, time_s, reaches: dict[str, float], wobbles: dict[str, float]) -> dict[str, np.ndarray]:
    """All motions at once, or each more in its turn and less otherwise; always with the wobble of a hand."""
    found = {}
    in_turn = rng.random() < 0.5
    order = rng.permutation(len(reaches))
    share = time_s / time_s[-1] * len(reaches)
    for place, (name, reach) in zip(order, reaches.items(), strict=True):
        moved = by_hand(rng, time_s, max(reach - wobbles[name], 0.0))
        if in_turn:
            moved = moved * np.clip(5 * np.minimum(share - place + 0.1, place + 1.1 - share), 0.6, 1.0)
        found[name] = moved + by_hand(rng, time_s, wobbles[name])
    return found


def scan(seed, missing: tuple[str, ...] = (), level: bool = False) -> Scan:
    """A scan of a floor without some motions."""
    rng = np.random.default_rng(seed)
    count = int(rng.choice([80, 100, 150, 250, 400] if missing else [150, 250, 400]))
    time_s = np.arange(count) * rng.uniform(0.12, 0.5)
    time_s += rng.uniform(-0.01, 0.01, count)
    time_s = np.maximum(time_s, 0.0)
    width, depth = rng.uniform(30, 60), rng.uniform(40, 120)
    columns, rows = rng.integers(128, 640), rng.integers(256, 800)
    pixel_mm = np.array([width / columns, depth / rows])
    middle = rng.uniform(0.4, 0.6) * depth
    reaches = {
        "tilt": rng.uniform(25, 35),
        "roll": rng.uniform(12, 20),
        "yaw": rng.uniform(20, 90),
        "depth": rng.uniform(0.2, 0.33) * depth,
    }
    wobbles = dict.fromkeys(("tilt", "roll", "yaw"), WOBBLE_DEG) | {"depth": WOBBLE_MM}
    for name in missing:
        reaches[name] = wobbles[name]
    moves = moves_of(rng, time_s, reaches, wobbles)
    tilt, roll, yaw = (np.deg2rad(moves[name]) for name in ("tilt", "roll", "yaw"))
    # The beam points down; the probe leans a little all the time.
    lean = np.deg2rad(rng.uniform(-5, 5, 2))
    turn = about(2, yaw) * BEAM_DOWN * about(2, roll + lean[0]) * about(0, tilt + lean[1])
    up = turn.inv().apply([0.0, 0.0, 1.0])
    pivot = rng.uniform(0.1, 0.9) * width
    at_depth = middle + moves["depth"]
    height = -(up[:, 0] * pivot + up[:, 1] * at_depth)
    over = np.column_stack([by_hand(rng, time_s, 60.0), by_hand(rng, time_s, 60.0), height])
    world_from_image = RigidTransform.from_components(over, turn)
    sides = np.array([0.02, 0.98]) * width
    at_sides = -(height[:, None] + up[:, :1] * sides) / up[:, 1:2]
    # The part of the line inside the image.
    slope = (at_sides[:, 1] - at_sides[:, 0]) / (sides[1] - sides[0])
    with np.errstate(divide="ignore"):
        limits = sides[0] + (np.array([1.0, depth - 1.0]) - at_sides[:, :1]) / slope[:, None]
    left = np.maximum(sides[0], np.nan_to_num(limits.min(axis=1), nan=-np.inf))
    right = np.minimum(sides[1], np.nan_to_num(limits.max(axis=1), nan=np.inf))
    seen = (right - left > 0.4 * width) & (rng.random(count) > rng.uniform(0.0, 0.1))
    across = np.column_stack([left, right])
    along = at_sides[:, :1] + slope[:, None] * (across - sides[0])
    along += rng.choice([0.05, 0.1, 0.2, 0.4] if missing else [0.05, 0.1, 0.2]) * rng.standard_normal(
        along.shape
    )
    ends_px = np.stack([across, along], axis=2) / pixel_mm
    mounting = RigidTransform.from_components(rng.uniform(-120, 120, 3), Rotation.random(rng=rng))
    floor = RigidTransform.from_components(
        rng.uniform(-300, 300, 3), Rotation.identity() if level else Rotation.random(rng=rng)
    )
    readings = floor * world_from_image * mounting.inv()
    shifts = rng.choice([0.02, 0.1, 0.2]) * rng.standard_normal((count, 3))
    turns = np.deg2rad(rng.choice([0.02, 0.05, 0.1]) * rng.standard_normal((count, 3)))
    if rng.random() < 0.5:
        # A scan is good if its tracker is, too.
        size = 1.0 if missing else 0.5
        shifts += 0.3 * size * wander(rng, time_s, DRIFT_S, 3)
        turns += np.deg2rad(0.2 * size * wander(rng, time_s, DRIFT_S, 3))
    wrong = RigidTransform.from_components(shifts, Rotation.from_rotvec(turns))
    place, orientation = readings.as_components()
    moved, turned = wrong.as_components()
    readings = RigidTransform.from_components(place + moved, turned * orientation)
    given_mm = pixel_mm * np.exp(0.01 * rng.standard_normal() + 0.01 * rng.standard_normal(2))
    return Scan(
        ends_px[seen],
        readings[seen],
        mounting,
        pixel_mm,
        given_mm,
        np.array([width, depth]),
        time_s[seen],
    )


def crossing(seed, still: tuple[str, ...]) -> tuple[ImagePoints, Scan]:
    """A crossing of wires seen at places all over the image, from a probe that turns about few axes."""
    made = scan([seed, 4], tuple(name for name in still if name != "depth"))
    rng = np.random.default_rng([seed, 5])
    count = len(made.ends_px)
    places = [by_hand(rng, made.time_s, 0.4) * length for length in made.size_mm]
    if "depth" in still:
        places[1] = by_hand(rng, made.time_s, WOBBLE_MM)
    at = np.column_stack(places) + made.size_mm / 2
    turn = (made.readings * made.mounting).rotation
    flat = np.column_stack([at, np.zeros(count)])
    world_from_image = RigidTransform.from_components(-turn.apply(flat), turn)
    readings = world_from_image * made.mounting.inv()
    shift, rotation = readings.as_components()
    shift = shift + 0.2 * wander(rng, made.time_s, DRIFT_S, 3) + 0.1 * rng.standard_normal((count, 3))
    pixels = (at + 0.2 * rng.standard_normal((count, 2))) / made.pixel_mm
    poses = RigidTransform.from_components(shift, rotation)
    return ImagePoints(pixels, np.arange(count), poses, time_s=made.time_s), made


def judged(trial) -> tuple[float, float, frozenset[str] | None]:
    """Errors in mm and degrees, and the motions named if refused."""
    kind, mode, seed = trial
    missing = MISSING.get(kind, ())
    place = sorted(MISSING).index(kind) if kind in MISSING else 9
    try:
        if mode == "directions":
            made = scan([seed, place], missing, level=True)
            solution = calibrate_orientation(made.lines, made.pixel_mm, OrientationFit(level=seed % 2 == 0))
            return 0.0, made.error(solution)[1], None
        if mode == "crossing":
            points, made = crossing([seed, place], missing)
            solution = calibrate_cross_wire(points)
        else:
            made = scan([seed, place], missing)
            given = {
                "prior": (made.given_mm,),
                "held": (made.pixel_mm, PlaneFit(fixed_pixels=True)),
                "unknown": (),
            }[mode]
            solution = calibrate_plane(made.lines, *given)
    except InsufficientDataError as refusal:
        return np.nan, np.nan, frozenset(word for word, text in WORDS.items() if text in str(refusal))
    return *made.error(solution), None


def missing_row(mode: str, kind: str, found: list) -> Row:
    errors = np.array([one[:2] for one in found])
    wrong = int(((errors[:, 0] > WRONG_MM) | (errors[:, 1] > WRONG_DEG)).sum())
    refused = [one[2] for one in found if one[2] is not None]
    # A direction has no depth; a crossing does not say which two axes it was not turned about.
    needed = frozenset(MISSING[kind]) - ({"depth"} if mode == "directions" else set())
    named = sum(one == needed for one in refused)
    share = named / len(refused) if refused else 1.0
    worst = np.nanmax(errors, axis=0) if len(refused) < len(found) else np.zeros(2)
    text = (
        f"{wrong} wrong of {len(found) - len(refused)} accepted (worst {worst[0]:.1f} mm, {worst[1]:.1f} "
        f"deg), {len(refused)} refused, motions named in {100 * share:.0f} %"
    )
    return Row(f"{kind}, {mode}", text, "0 wrong; 95 % named", wrong == 0 and share >= 0.95)


def measure(share: float, first_seed: int) -> list[Row]:
    """Missing motions (100 scans of each kind) and good scans (300)."""
    rows = []
    count = max(1, round(100 * share))
    seeds = [first_seed + k for k in range(count)]
    for mode in ("prior", "held", "unknown", "directions"):
        for kind in MISSING:
            if mode == "directions" and kind == "constant depth":
                continue
            rows.append(missing_row(mode, kind, trials(judged, [(kind, mode, seed) for seed in seeds])))
    for kind, mode in (("good", "prior"), ("good", "held"), ("good", "crossing")):
        found = trials(judged, [(kind, mode, seed) for seed in seeds])
        refused = sum(one[2] is not None for one in found)
        worst = np.nanmax([one[:2] for one in found], axis=0)
        text = f"{refused} of {len(found)} refused, worst {worst[0]:.1f} mm, {worst[1]:.1f} deg"
        rows.append(Row(f"{kind} scans, {mode}", text, "0 refused", refused == 0))
    return rows
