"""Calibration from two sweeps: what is refused, and whether the errors claimed for the rest are true.

The tissue is that of `crossing_scenes`, which is not the calibration's model; each start is off by up to
1.5 mm and degrees in each parameter.
"""

from functools import partial

import numpy as np
from crossing_scenes import centre_error_mm, crossing_sweeps, displace

from calibration.images.angulation import angulation
from calibration.images.similarity import prepare
from calibration.images.solver import calibrate_images
from calibration.settings import ImageFit
from speckle3d.core.errors import InsufficientDataError

from .rows import Row, trials

COUNT = 24


def judge(crossing_deg, seed):
    """Errors of turns (degrees) and of the image's centre (mm), and those claimed; None where refused."""
    rng = np.random.default_rng(seed)
    first, second, truth = crossing_sweeps(
        seed, frames=50, fan_deg=rng.uniform(35.0, 50.0), crossing_deg=rng.uniform(*crossing_deg)
    )
    start, grid = displace(truth, rng, 1.5, 1.5), first.grid
    poses = [s.world_from_sensor(s.covered()) for s in (first, second)]
    try:  # as the command does it: the motion is judged first at the start
        angulation(*poses, start).require(0.5)
        solution = calibrate_images(prepare(first, second), start, ImageFit(capture_mm=0.0, capture_deg=0.0))
    except InsufficientDataError:
        return None
    turns = (truth.inv() * solution.sensor_from_image).rotation.as_rotvec(degrees=True)
    sigma = np.rad2deg(np.sqrt(np.diag(solution.covariance)[:3]))
    shifts = centre_error_mm(solution.sensor_from_image, truth, grid)
    return [*turns, *shifts], [*sigma, *np.sqrt(np.diag(solution.covariance_of(grid.centre_mm)))]


def measure(share, first_seed):
    """Sweeps that cross, and parallel ones."""
    seeds = range(first_seed, first_seed + max(2, round(share * COUNT)))
    parallel = trials(partial(judge, (0.0, 3.0)), seeds)
    refusals = sum(o is None for o in parallel)
    rows = [Row("parallel", f"{refusals} of {len(parallel)} refused", "all", refusals == len(parallel))]
    outcomes = trials(partial(judge, (70.0, 90.0)), seeds)
    error, sigma = np.array([o for o in outcomes if o is not None]).transpose(1, 0, 2)
    ratio = np.abs(error / sigma)
    turn, shift = (np.median(np.abs(part)) for part in (error[:, :3], error[:, 3:]))
    text = (
        f"{len(outcomes) - len(error)} of {len(outcomes)} refused; largest z {ratio.max():.1f}, RMS z "
        f"{np.sqrt(np.mean(ratio**2)):.2f}; median errors {turn:.2f} deg, {shift:.2f} mm"
    )
    target = "none refused, none over 3 claimed errors"
    return [*rows, Row("crossing", text, target, len(error) == len(outcomes) and bool(ratio.max() <= 3.0))]
