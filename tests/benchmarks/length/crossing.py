"""Crossing pairs over simulated tissue: errors of length and tilt, what is refused, whether claims hold.

The tissue is not the estimator's model: see `crossing_tissue`.
"""

import numpy as np
from crossing_tissue import GRID, PairCase, tissue_pair

from length.sweeps import figures
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.correction.crossing.pair import solve_crossing

GROUPS = {
    "90 deg": {},
    "90 deg, orientation": {"with_sensor": True},
    "45 deg": {"angle_deg": 45.0},
    "tissue moved 0.3 mm rms": {"moved_mm": 0.3},
    "tissue moved 0.6 mm rms": {"moved_mm": 0.6},
    "tissue moved 1.0 mm rms": {"moved_mm": 1.0},
    "poor texture": {"texture": 0.3},
    "sign of the second unknown": {"mirror": True},
}
PAIRS = 8
"""Of each group, at share 1."""


def measure(share, first_seed):
    """Name and figures of all groups; `share` of the pairs of each."""
    everything = []
    for number, (name, settings) in enumerate(GROUPS.items()):
        seeds = range(first_seed + 100 * number, first_seed + 100 * number + max(1, round(share * PAIRS)))
        sides = [side for seed in seeds for side in sides_of(PairCase(seed, **settings))]
        everything += sides
        yield name, figures(sides)
    yield "all", figures(everything)


def sides_of(case):
    """Of both sweeps: log of the length's error, tilt in degrees, and the length's claim; or why not."""
    pair = tissue_pair(case)
    try:
        correction = solve_crossing(pair.first, pair.second)
    except (InsufficientDataError, MismatchError) as error:
        return [str(error)] * 2
    sides = []
    for side, truth in zip((correction.first, correction.second), pair.truth, strict=True):
        length, true = (
            np.linalg.norm(np.ptp(poses[[0, -1]].apply(GRID.centre_mm), axis=0))
            for poses in (side.poses, truth)
        )
        turns = [(poses[0].inv() * poses[-1]).rotation for poses in (truth, side.poses)]
        tilt_deg = (turns[0].inv() * turns[1]).as_rotvec(degrees=True)[0]
        sides.append((100 * np.log(length / true), tilt_deg, 100 * side.length_sigma))
    return sides
