"""Plane: whether errors lie within the standard errors claimed, with trackers that drift or not."""

from functools import partial

import numpy as np
from floor_scenes import Floor

from calibration.plane import calibrate_plane
from calibration.points import ImagePoints
from speckle3d.core.errors import InsufficientDataError

from .rows import Row, coverage_row, trials

COUNT = 150


def judge(smoothly, drifts, seed):
    """Errors over claims of pose and pixel size in the image's frame, or None if refused."""
    floor = Floor([seed, 1997])
    at = floor.time_s if smoothly else floor.rng.permutation(floor.time_s)
    readings = floor.readings(floor.time_s, drifts)
    if not smoothly:  # the errors' times are the frames', the poses are in any order
        exact, pose = (
            floor.world_from_floor * floor.image(t) * floor.mounting.inv() for t in (floor.time_s, at)
        )
        readings = readings * exact.inv() * pose
    points = ImagePoints.of_lines(np.arange(len(at)), floor.lines(at), readings, floor.time_s)
    try:
        solution = calibrate_plane(points)
    except InsufficientDataError:
        return None
    step = solution.chain.sensor_from_image.inv() * floor.mounting
    pixels = floor.pixel_mm - solution.chain.pixel_mm
    errors = np.concatenate([pixels, step.translation, step.rotation.as_rotvec()[::-1]])
    return errors / np.sqrt(np.diag(solution.covariance))[: len(errors)]


def measure(share, first_seed):
    """Coverage with white errors, and with drifting ones besides."""
    rows = []
    seeds = range(first_seed, first_seed + max(4, round(COUNT * share)))
    for drifts in (False, True):
        for smoothly in (True, False):
            outcomes = trials(partial(judge, smoothly, drifts), seeds)
            scores = np.array([o for o in outcomes if o is not None])
            case = (
                f"plane, {'drift' if drifts else 'white noise'}, {'smooth' if smoothly else 'random poses'}"
            )
            row = coverage_row(case, scores)
            refusals = sum(o is None for o in outcomes)
            rows.append(Row(case, f"{row.figures}, {refusals} refused", row.target, row.is_on_target))
    return rows
