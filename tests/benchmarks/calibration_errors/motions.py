"""Motions that are missing, and good scans: what is accepted, how wrong it is, what is named."""

import numpy as np
from floor_scenes import Floor

from calibration.motion import MOTIONS
from calibration.orientation import OrientationFit, calibrate_orientation
from calibration.plane import PlaneFit, calibrate_plane
from calibration.points import ImagePoints
from speckle3d.core.errors import InsufficientDataError

from .rows import Row, trials

WRONG = np.array([5.0, 5.0])
"""Millimetres and degrees."""
MISSING = {
    "good": (),
    "constant depth": ("depth",),
    "no tilt": ("tilt",),
    "no roll": ("roll",),
    "yaw only": ("tilt", "roll", "depth"),
}
WORDS = dict(zip(("tilt", "yaw", "roll", "sideways", "depth"), MOTIONS, strict=True))


def errors_of(solution, floor):
    """Worst of the image's corners, mm, and the rotation, degrees."""
    chain = solution.chain
    corners = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]]) * floor.size_mm
    flat, scale = np.zeros(4), chain.pixel_mm / floor.pixel_mm
    estimate = chain.sensor_from_image.apply(np.column_stack([corners * scale, flat]))
    truth = floor.mounting.apply(np.column_stack([corners, flat]))
    turn = (floor.mounting.rotation.inv() * chain.sensor_from_image.rotation).magnitude()
    return np.linalg.norm(estimate - truth, axis=1).max(), np.rad2deg(turn)


def judge(trial):
    """Errors in mm and degrees, and the motions named if refused."""
    kind, mode, seed = trial
    floor = Floor([seed, list(MISSING).index(kind)], MISSING[kind], level=mode == "directions")
    time_s, rng = floor.time_s, floor.rng
    readings = floor.readings(time_s, drifts=bool(rng.integers(2)))
    lines = ImagePoints.of_lines(np.arange(len(time_s)), floor.lines(time_s), readings, time_s)
    try:
        if mode == "directions":
            solution = calibrate_orientation(lines, floor.pixel_mm, OrientationFit(level=seed % 2 == 0))
            return 0.0, errors_of(solution, floor)[1], None
        prior_mm = floor.pixel_mm * (np.exp(0.01 * rng.standard_normal(2)) if mode == "prior" else 1.0)
        solution = calibrate_plane(lines, prior_mm, PlaneFit(fixed_pixels=mode == "held"))
    except InsufficientDataError as refusal:
        return np.nan, np.nan, frozenset(word for word, text in WORDS.items() if text in str(refusal))
    return *errors_of(solution, floor), None


def row_of(kind, mode, outcomes):
    """How many were refused and wrong, and whether all that lacks was named."""
    errors = np.array([o[:2] for o in outcomes])
    refusals = [o[2] for o in outcomes if o[2] is not None]
    worst = np.nanmax(errors, axis=0, initial=0.0)
    wrong = int((errors > WRONG).any(axis=1).sum())
    # A direction has no depth.
    missing = frozenset(MISSING[kind]) - ({"depth"} if mode == "directions" else set())
    share = np.mean([motions == missing for motions in refusals]) if refusals else 1.0
    text = (
        f"{len(refusals)} of {len(outcomes)} refused, motions named in {100 * share:.0f} %; "
        f"{wrong} of the others wrong, worst {worst[0]:.1f} mm, {worst[1]:.1f} deg"
    )
    if kind == "good":
        return Row(f"good scans, {mode}", text, "0 refused", not refusals)
    return Row(f"{kind}, {mode}", text, "0 wrong; 95 % named", wrong == 0 and share >= 0.95)


def measure(share, first_seed):
    """Scans that lack a motion, and good ones, with the pixel size about known, held, or of no matter."""
    seeds = range(first_seed, first_seed + max(1, round(100 * share)))
    cases = [(kind, mode) for mode in ("prior", "held", "directions") for kind in MISSING]
    cases.remove(("constant depth", "directions"))
    return [row_of(*case, trials(judge, [(*case, seed) for seed in seeds])) for case in cases]
