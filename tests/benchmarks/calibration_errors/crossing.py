"""Crossing wires found in simulated B-mode images.

The images come from `crossing_images`: wires met by a thick beam, with all that scanners add, of linear and
convex probes 40 to 150 mm deep.
"""

import numpy as np
from crossing_images import crossing_world

from calibration.detection.crossings import crossings_in_frames
from calibration.wires import calibrate_cross_wire
from speckle3d.core.errors import InsufficientDataError

from .rows import Row, trials

NEAR_MM, WORLDS = 2.0, 60


def judge(seed):
    """Share of the crossings found, share of the used that are wrong, and RMS, mm, NaN if refused."""
    world = crossing_world(seed)
    # The size a user reads off the scanner's ruler.
    ruler_mm = world.pixel_mm * np.random.default_rng([seed, 1]).uniform(0.95, 1.05, 2)
    dots = crossings_in_frames(world.images, ruler_mm)
    try:
        solution = calibrate_cross_wire(dots.points(world.world_from_sensor[dots.frame]), ruler_mm)
    except InsufficientDataError:
        return 0.0, 0.0, np.nan
    inliers = solution.points_used
    off_mm = np.hypot(*((inliers.pixels - world.crossing_px[inliers.frame]) * world.pixel_mm).T)
    right = off_mm < NEAR_MM
    share = np.isin(np.flatnonzero(world.is_visible), inliers.frame[right]).mean()
    return share, 1.0 - right.mean(), solution.rms


def measure(share, first_seed):
    """How many crossings are found, and how well the calibration explains them."""
    detection, wrong, rms = np.array(
        trials(judge, range(first_seed, first_seed + max(2, round(share * WORLDS)))), float
    ).T
    text = (
        f"{100 * detection.mean():.0f} % ({int(np.isnan(rms).sum())} of {len(rms)} recordings refused), "
        f"{100 * wrong.mean():.1f} % of those used wrong"
    )
    mean, worst = np.nanmean(rms), np.nanmax(rms)
    return [
        Row("crossings found", text, ">= 80 %", bool(detection.mean() >= 0.8)),
        Row("RMS a component", f"mean {mean:.2f}, worst {worst:.2f} mm", "<= 1 mm", bool(worst <= 1.0)),
    ]
