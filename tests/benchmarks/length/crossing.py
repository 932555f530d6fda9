"""Crossing pairs over simulated tissue: errors of length and tilt, what is refused, whether claims hold.

The tissue is not the estimator's model: see `crossing_tissue`. A length is confident and wrong where it is
off by more than three of its own claimed deviations and by more than 2 %.
"""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from crossing_tissue import GRID, PairCase, made_pair

from length.rows import Row
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.correction.crossing.pair import crossed


@dataclass(frozen=True)
class _Group:
    """Pairs of one kind, and what they should reach."""

    name: str
    pairs: int
    target: str
    settings: dict[str, Any] = field(default_factory=dict)


GROUPS = (
    _Group("90 deg", 16, "length <= 1 %, 90th 2 %; tilt <= 0.5 deg"),
    _Group("90 deg, orientation", 16, "length <= 1 %, 90th 2 %; tilt <= 0.2 deg", {"sensed": True}),
    _Group("75 deg", 4, "length <= 2 %", {"angle_deg": 75.0}),
    _Group("60 deg", 4, "length <= 2 %", {"angle_deg": 60.0}),
    _Group("45 deg", 8, "length <= 2 %; tilt <= 0.7 deg", {"angle_deg": 45.0}),
    _Group("30 deg", 4, "refused or holding", {"angle_deg": 30.0}),
    _Group("20 deg", 4, "refused", {"angle_deg": 20.0}),
    _Group("18 mm", 4, "refused or holding", {"length_mm": 18.0, "frames": 110}),
    _Group("12 mm", 4, "refused", {"length_mm": 12.0, "frames": 80}),
    _Group("tissue moved 0.3 mm rms", 6, "refused or holding", {"moved_mm": 0.3}),
    _Group("tissue moved 0.6 mm rms", 6, "refused or holding", {"moved_mm": 0.6}),
    _Group("tissue moved 1.0 mm rms", 6, "refused or holding", {"moved_mm": 1.0}),
    _Group("poor texture", 6, "refused or holding", {"texture": 0.3}),
    _Group("70 % of the speckle is each sweep's own", 4, "length <= 1.5 %", {"own": 0.7}),
    _Group("odd motion", 6, "length <= 2 %", {"odd": True}),
    _Group("sign of the second unknown", 4, "sign found", {"mirrored": True}),
)


@dataclass(frozen=True)
class _Outcome:
    """Of one pair: by sweep, before, after and claimed in per cent, and tilt in degrees; or why not."""

    sides: tuple[tuple[float, float, float, float], ...]
    seconds: float
    mirrored: tuple[bool, bool] = (False, False)
    refused: str = ""


def measure(share: float = 1.0, first_seed: int = 970_001) -> list[Row]:
    """Rows of all groups; `share` of the pairs of each."""
    rows, everything, kept = [], [], []
    for number, group in enumerate(GROUPS):
        cases = [
            PairCase(first_seed + 100 * number + k, **group.settings)
            for k in range(max(1, round(share * group.pairs)))
        ]
        found = [_solved(case) for case in cases]
        rows.append(Row(group.name, _figures(cases, found), group.target))
        everything += found
        kept += [side for one in found for side in one.sides]
    rows.append(
        Row("all that were not refused", _coverage(kept), "68 %: 60 to 76; 95 %: 90 to 98; none wrong")
    )
    seconds = [one.seconds for one in everything]
    rows.append(
        Row(
            "time of a pair",
            f"median {np.median(seconds):.1f}, longest {max(seconds):.1f} s",
            "<= 5 s on two cores",
        )
    )
    return rows


def _solved(case: PairCase) -> _Outcome:
    pair = made_pair(case)
    began = time.process_time()
    try:
        found = crossed(pair.first, pair.second)
    except (InsufficientDataError, MismatchError) as error:
        return _Outcome((), time.process_time() - began, refused=str(error))
    seconds = time.process_time() - began
    sides = []
    for side, given, truth in zip(
        (found.first, found.second), (pair.first, pair.second), pair.truth, strict=True
    ):
        lengths = [_length(poses) for poses in (given.poses, side.poses, truth)]
        turns = [(poses[0].inv() * poses[-1]).rotation for poses in (truth, side.poses)]
        tilt = np.rad2deg((turns[0].inv() * turns[1]).as_rotvec()[0])
        before, after = (100 * np.log(each / lengths[2]) for each in lengths[:2])
        sides.append((float(before), float(after), 100 * side.log_scale_sigma, float(tilt)))
    return _Outcome(tuple(sides), seconds, found.mirrored)


def _length(poses):
    ends = poses.apply(GRID.centre_mm)
    return np.linalg.norm(ends[-1] - ends[0])


def _figures(cases, found):
    refused = [one.refused for one in found if one.refused]
    text = f"{len(refused)} of {len(found)} refused"
    sides = np.array([side for one in found for side in one.sides])
    if len(sides):
        before, after, tilt = (np.abs(sides[:, k]) for k in (0, 1, 3))
        text += (
            f"; length {np.median(before):.1f} -> median {np.median(after):.2f}, "
            f"90th {np.quantile(after, 0.9):.2f} %"
            f", claimed {np.median(sides[:, 2]):.2f} %; tilt median {np.median(tilt):.2f} deg"
        )
    signs = [
        one.mirrored == (False, case.mirrored) for one, case in zip(found, cases, strict=True) if one.sides
    ]
    if not all(signs):
        text += f"; {signs.count(False)} with the wrong sign"
    return text


def _coverage(sides):
    off, claimed = np.abs([s[1] for s in sides]), np.array([s[2] for s in sides])
    wrong = int(((off > 3 * claimed) & (off > 2.0)).sum())
    inside = [100 * np.mean(off < z * claimed) for z in (1.0, 1.96)]
    return f"{len(sides)} sweeps; 68 %: {inside[0]:.0f}, 95 %: {inside[1]:.0f}; {wrong} confident and wrong"
