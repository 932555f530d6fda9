"""Crossing wires found in simulated B-mode images, and picks of which half or more are wrong.

The images come from `crossing_images`: wires met by a thick beam, with all that scanners add, of linear and
convex probes 40 to 150 mm deep.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration_errors.rows import Row, trials

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from crossing_images import crossing_world

from calibration.detection.crossings import crossings_in_frames
from calibration.points import ImagePoints
from calibration.wires import calibrate_cross_wire
from speckle3d.core.errors import InsufficientDataError

NEAR_MM = 2.0
WORLDS, PICKED, CHANCE = 60, 200, 400


def away_mm(world, pixels, frame):
    """Distance of places in images from the crossing."""
    return np.hypot(*((pixels - world.crossing_px[frame]) * world.pixel_mm).T)


def solved(points, pixel_mm):
    """The solution, or None if it is refused."""
    try:
        return calibrate_cross_wire(points, pixel_mm)
    except InsufficientDataError:
        return None


def of_images(seed):
    """Share offered, share found, share of the used that are wrong, RMS, corner error, exchanged accepted."""
    rng = np.random.default_rng([seed, 1])
    world = crossing_world(seed)
    # The size a user reads off the scanner's ruler.
    given = world.pixel_mm * rng.uniform(0.95, 1.05, 2)
    seen = crossings_in_frames(world.images, given)
    shown = np.flatnonzero(world.shown)
    near = away_mm(world, seen.pixels, seen.frame) < NEAR_MM
    offered = np.isin(shown, seen.frame[near]).mean()
    other = rng.permutation(len(world.images))
    exchanged = solved(seen.points(world.world_from_sensor[other[seen.frame]]), given) is not None
    solution = solved(seen.points(world.world_from_sensor[seen.frame]), given)
    if solution is None:
        return offered, 0.0, 0.0, np.nan, np.nan, exchanged
    picked = solution.points_used
    right = away_mm(world, picked.pixels, picked.frame) < NEAR_MM
    found = np.isin(shown, picked.frame[right]).mean()
    return offered, found, 1.0 - right.mean(), solution.rms, corner_error_mm(world, solution), exchanged


def corner_error_mm(world, solution):
    """RMS error, in the sensor's frame, of the corners of what the crossing covered."""
    low, high = np.percentile(world.crossing_px[world.shown], [5, 95], axis=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    flat = np.zeros((4, 1))
    found = solution.chain.sensor_from_image.apply(np.hstack([corners * solution.chain.pixel_mm, flat]))
    true = world.sensor_from_image.apply(np.hstack([corners * world.pixel_mm, flat]))
    return float(np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1))))


def picks(rng, count):
    """Picks of one crossing by a hand, their poses, and the pixel size: no images."""
    pixel = np.full(2, rng.uniform(0.1, 0.3))
    turns = Rotation.from_euler("yxz", rng.normal(0, np.deg2rad([20, 18, 15]), (count, 3)))
    turns = Rotation.random(rng=rng) * turns
    pixels = rng.uniform([40, 60], [440, 440], (count, 2))
    flat = np.column_stack([pixels * pixel, rng.normal(0, 0.5, count)])
    poses = RigidTransform.from_components(rng.uniform(-200, 200, 3) - turns.apply(flat), turns)
    mounting = RigidTransform.from_components(rng.uniform(-100, 100, 3), Rotation.random(rng=rng))
    pixels = pixels + rng.normal(0, 0.4, (count, 2)) / pixel
    return pixels, poses * mounting.inv(), pixel


def of_picks(seed):
    """Whether 52 picks are solved, wrong ones used, right ones lost; a half or two thirds are wrong."""
    rng = np.random.default_rng([seed, 2])
    pixels, readings, pixel = picks(rng, 52)
    wrong = rng.permutation(52) < (26 if seed % 2 else 35)
    # Side lobes and ends of wires lie near; speckle lies anywhere.
    near = pixels + rng.normal(0, 15.0, pixels.shape) / pixel
    spoilt = np.where(rng.random((52, 1)) < 0.5, near, rng.uniform(0, 480, pixels.shape))
    true = pixels.copy()
    pixels = np.where(wrong[:, None], spoilt, pixels)
    solution = solved(ImagePoints(pixels, np.arange(52), readings), pixel)
    if solution is None:
        return False, 0.0, 0.0, np.nan
    far = np.hypot(*((pixels - true) * pixel).T) > 6.0
    return True, solution.used[far].mean(), (~solution.used[~wrong]).mean(), solution.rms


def of_chance(seed):
    """Whether candidates that show nothing are calibrated with: 8 to 80 frames, one or six in each."""
    rng = np.random.default_rng([seed, 3])
    frames, each = int(rng.integers(8, 80)), (1, 6)[seed % 2]
    _, readings, pixel = picks(rng, frames)
    where = (
        rng.normal(240, 90, (frames * each, 2))
        if rng.random() < 0.5
        else rng.uniform(0, 480, (frames * each, 2))
    )
    frame = np.repeat(np.arange(frames), each)
    return solved(ImagePoints(where, frame, readings[frame]), pixel) is not None


def measure(share, first_seed):
    """Rows of crossing wires."""

    def seeds(count):
        return range(first_seed, first_seed + max(2, round(share * count)))

    offered, found, wrong, rms, corners, exchanged = np.array(trials(of_images, seeds(WORLDS)), float).T
    done, used, lost, picked_rms = np.array(trials(of_picks, seeds(PICKED)), float).T
    accepted = np.array(trials(of_chance, seeds(CHANCE)))
    solved_rms = rms[np.isfinite(rms)]
    return [
        Row(
            "crossings found in simulated images",
            f"{100 * found.mean():.0f} % ({100 * offered.mean():.0f} % offered; worst recording "
            f"{100 * found.min():.0f} %; {int(np.isnan(rms).sum())} of {len(rms)} recordings refused), "
            f"{100 * wrong.mean():.1f} % of those used wrong",
            ">= 80 %",
            bool(found.mean() >= 0.8),
        ),
        Row(
            "  RMS of the calibration, a component",
            f"mean {np.mean(solved_rms):.2f}, worst {np.max(solved_rms):.2f} mm; corners off by "
            f"{np.nanmedian(corners):.2f} (median), {np.nanmax(corners):.2f} mm (worst)",
            "<= 1 mm",
            bool(np.max(solved_rms) <= 1.0),
        ),
        Row(
            "  images with the poses of other frames accepted",
            f"{int(exchanged.sum())} of {len(exchanged)}",
            "0",
            not exchanged.any(),
        ),
        Row(
            "picks of which a half or two thirds are wrong: solved",
            f"{int(done.sum())} of {len(done)}, {100 * used.mean():.1f} % of the wrong used, "
            f"{100 * lost.mean():.1f} % of the right lost, RMS up to {np.nanmax(picked_rms):.2f} mm",
            "all, <= 1 mm",
            bool(done.all() and np.nanmax(picked_rms) <= 1.0),
        ),
        Row(
            "chance candidates accepted", f"{int(accepted.sum())} of {len(accepted)}", "0", not accepted.any()
        ),
    ]
