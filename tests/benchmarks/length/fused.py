"""Mode `fused`: whether claims hold, time; by itself, also short RF sweeps.

``python tests/benchmarks/length/fused.py [--first-seed N] [--count N] [--cache DIR]``
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from cache import DEFAULT
from fused_scenes import errors, scene
from rows import Row, show
from scenes import FIRST_SEED, borrowed_curves, short

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.correction.fused import fuse
from speckle3d.corrections import correct
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import track
from speckle3d.scoring.lengths import compare_modes

CURVES = Path(__file__).resolve().parents[3] / "data" / "curves.h5"
MISMATCH = 0.06
"""Relative standard deviation of the scale that borrowed curves add."""
PATHS = 48
LONG = {"frames": 300, "length_mm": 24.0}


def measure(share: float = 1.0, first_seed: int = FIRST_SEED) -> list[Row]:
    """Coverage over simulated paths, and time."""
    return [_coverage(range(first_seed, first_seed + max(8, round(PATHS * share)))), _speed(first_seed)]


def on_sweeps(first_seed: int, count: int, folder: Path) -> list[Row]:
    """Errors of single modes and of `fused` on RF sweeps of 3.6 to 6 mm."""
    seeds = range(first_seed, first_seed + count)
    return [
        *_on_sweeps(seeds, folder, read_curves(CURVES), 0.0, "curves right"),
        *_on_sweeps(seeds, folder, borrowed_curves(22.0, 0.8, folder), MISMATCH, "curves borrowed"),
    ]


def _on_sweeps(
    seeds: range, folder: Path, curves: DecorrelationCurves, mismatch: float, case: str
) -> list[Row]:
    found: dict[str, list[list[float]]] = {}
    for seed in seeds:
        sweep = load_sweep(short(seed, folder))
        tracked = track(sweep, curves)
        corrected = correct(tracked, sweep, ["orientation", "pose"])
        given = (
            tracked.edges,
            tracked.image,
            0.0 if tracked.coherence is None else float(tracked.coherence.share.mean()),
            float(np.hypot(tracked.scale_sigma, mismatch)),
            float(np.hypot(tracked.curves_sigma, mismatch)),
            tracked.shared.turn_sigma_per_mm,
            sweep.grid.centre_mm,
            sweep.frame_time_s,
        )
        modes = {
            "image": tracked.image,
            **{mode: each.poses for mode, each in corrected.items()},
            "fused with orientation": fuse(*given, orientation=sweep.orientation).poses,
            "fused with tracker": fuse(*given, tracker=sweep.tracker).poses,
            "fused with both": fuse(*given, sweep.orientation, sweep.tracker).poses,
        }
        assert sweep.truth is not None
        for row in compare_modes(modes, sweep.truth, sweep.grid.centre_mm, end_frames=1):
            angles = (row.tilt_error_deg, row.yaw_error_deg, row.roll_error_deg)
            found.setdefault(row.mode, []).append([abs(e) for e in (row.length_error_percent, *angles)])
    targets = {
        "fused with tracker": "length <= the better of image and pose, tilt <= 0.1 deg",
        "fused with orientation": "length as image, angles <= orientation's and <= 0.1 deg",
    }
    rows = []
    for mode, values in found.items():
        length, tilt, yaw, roll = np.median(values, axis=0)
        figures = f"length {length:.2f} %, tilt {tilt:.2f}, yaw {yaw:.2f}, roll {roll:.2f} deg (medians)"
        rows.append(Row(f"3.6 to 6 mm, {case}: {mode}", figures, targets.get(mode, "-")))
    return rows


def _coverage(seeds: range) -> Row:
    """How often errors of length and angles are within what is claimed, by one sensor or both."""
    figures = []
    for name in ("orientation", "tracker", "both"):
        size = []
        for seed in seeds:
            made = scene(seed)
            orientation = None if name == "tracker" else made.orientation
            tracker = None if name == "orientation" else made.tracker
            found = fuse(*made.given(), orientation, tracker)
            size.append(np.abs(errors(found.poses, made.truth)) / np.sqrt(np.diag(found.covariance[-1])))
        length, angles = np.array(size)[:, 2], np.array(size)[:, 3:]
        parts = [f"{np.mean(each < s):.0%}" for each in (length, angles) for s in (1.0, 1.96)]
        figures.append(f"{name}: length {parts[0]} and {parts[1]}, angles {parts[2]} and {parts[3]}")
    return Row(
        f"68 and 95 % intervals, {len(seeds)} simulated paths", "; ".join(figures), "60 to 76, 90 to 98 %"
    )


def _speed(seed: int) -> Row:
    made = scene(seed, **LONG)
    fuse(*made.given(), made.orientation, made.tracker)
    started = time.process_time()
    fuse(*made.given(), made.orientation, made.tracker)
    seconds = time.process_time() - started
    size = f"{LONG['frames']} frames, {len(made.edges)} edges, both sensors"
    figures = f"{seconds:.2f} s of processor time for {size}"
    return Row("time", figures, "well under 1 s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=6)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    show([*on_sweeps(options.first_seed, options.count, options.cache), *measure(1.0, options.first_seed)])


if __name__ == "__main__":
    main()
