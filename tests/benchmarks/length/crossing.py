"""Crossing pairs over simulated tissue: errors of length and tilt, what is refused, whether claims hold.

The tissue is not the estimator's model: see `crossing_tissue`. A length is confident and wrong where it is
off by more than three of its own claimed deviations and by more than 2 %.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from crossing_tissue import GRID, PairCase, made_pair

from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.correction.crossing.pair import crossed

GROUPS = {
    "90 deg": {},
    "90 deg, orientation": {"sensed": True},
    "45 deg": {"angle_deg": 45.0},
    "tissue moved 0.3 mm rms": {"moved_mm": 0.3},
    "tissue moved 0.6 mm rms": {"moved_mm": 0.6},
    "tissue moved 1.0 mm rms": {"moved_mm": 1.0},
    "poor texture": {"texture": 0.3},
    "sign of the second unknown": {"mirrored": True},
}
PAIRS = 8
"""Of each group, at share 1."""


def measure(share, first_seed):
    """Name and figures of all groups; `share` of the pairs of each."""
    everything = []
    for number, (name, settings) in enumerate(GROUPS.items()):
        seeds = range(first_seed + 100 * number, first_seed + 100 * number + max(1, round(share * PAIRS)))
        found = [solved(PairCase(seed, **settings)) for seed in seeds]
        everything += found
        yield name, figures(found)
    yield "all", figures(everything)


def solved(case):
    """Of both sweeps: log of the length's error and its claim, tilt in degrees; None where refused."""
    pair = made_pair(case)
    try:
        found = crossed(pair.first, pair.second)
    except (InsufficientDataError, MismatchError):
        return None
    sides = []
    for side, truth in zip((found.first, found.second), pair.truth, strict=True):
        length, true = (
            np.linalg.norm(np.ptp(poses[[0, -1]].apply(GRID.centre_mm), axis=0))
            for poses in (side.poses, truth)
        )
        turns = [(poses[0].inv() * poses[-1]).rotation for poses in (truth, side.poses)]
        tilt_deg = (turns[0].inv() * turns[1]).as_rotvec(degrees=True)[0]
        sides.append((100 * np.log(length / true), 100 * side.log_scale_sigma, tilt_deg))
    return sides


def figures(found):
    """Errors and coverage of those that were not refused."""
    sides = np.abs([side for one in found if one is not None for side in one])
    text = f"{sum(one is None for one in found)} of {len(found)} refused"
    if not len(sides):
        return text
    off, claimed, tilt = sides.T
    inside = [100 * np.mean(off < z * claimed) for z in (1.0, 1.96)]
    wrong = int(((off > 3 * claimed) & (off > 2.0)).sum())
    return (
        f"{text}; length {np.median(off):.2f} %, 90th {np.quantile(off, 0.9):.2f} %, claimed "
        f"{np.median(claimed):.2f} %, 68 %: {inside[0]:.0f}, 95 %: {inside[1]:.0f}; "
        f"{wrong} confident and wrong; tilt {np.median(tilt):.2f} deg"
    )
