"""Calibration from two sweeps: what is refused, and whether the errors claimed for the rest are true.

The tissue is that of `crossing_scenes`, which is not the calibration's model; each start is off by up to
1.5 mm and degrees in each parameter.
"""

from functools import partial

import numpy as np
from crossing_scenes import centre_error_mm, crossing_sweeps, displace

from calibration.images.angulation import angulation
from calibration.images.solver import calibrate_images
from calibration.settings import ImageFit
from speckle3d.core.errors import InsufficientDataError

from .rows import Row, trials

COUNT = 24


def judged(crossing_deg, seed):
    """Errors of turns (degrees) and of the image's centre (mm), and those claimed; None where refused."""
    rng = np.random.default_rng(seed)
    first, second, truth = crossing_sweeps(
        seed, frames=50, fan_deg=rng.uniform(35.0, 50.0), crossing_deg=rng.uniform(*crossing_deg)
    )
    start, grid = displace(truth, rng, 1.5, 1.5), first.grid
    poses = [each.world_from_sensor(each.covered()) for each in (first, second)]
    try:  # as the command does it: the motion is judged first at the start
        angulation(*poses, start).require(0.5)
        found = calibrate_images(first, second, start, ImageFit(capture_mm=0.0, capture_deg=0.0))
    except InsufficientDataError:
        return None
    turns = (truth.inv() * found.sensor_from_image).rotation.as_rotvec(degrees=True)
    claimed = np.rad2deg(np.sqrt(np.diag(found.covariance)[:3]))
    shifts = centre_error_mm(found.sensor_from_image, truth, grid)
    return [*turns, *shifts], [*claimed, *np.sqrt(np.diag(found.covariance_of(grid.centre_mm)))]


def measure(share, first_seed):
    """Sweeps that cross, and parallel ones."""
    seeds = range(first_seed, first_seed + max(2, round(share * COUNT)))
    parallel = trials(partial(judged, (0.0, 3.0)), seeds)
    refused = sum(one is None for one in parallel)
    rows = [Row("parallel", f"{refused} of {len(parallel)} refused", "all", refused == len(parallel))]
    found = trials(partial(judged, (70.0, 90.0)), seeds)
    error, claimed = np.array([one for one in found if one is not None]).transpose(1, 0, 2)
    ratio = np.abs(error / claimed)
    turn, shift = (np.median(np.abs(part)) for part in (error[:, :3], error[:, 3:]))
    text = (
        f"{len(found) - len(error)} of {len(found)} refused; largest z {ratio.max():.1f}, RMS z "
        f"{np.sqrt(np.mean(ratio**2)):.2f}; median errors {turn:.2f} deg, {shift:.2f} mm"
    )
    target = "none refused, none over 3 claimed errors"
    return [*rows, Row("crossing", text, target, len(error) == len(found) and bool(ratio.max() <= 3.0))]
