"""Calibration from two crossing sweeps: the published method beside Gauss-Newton on the same starts.

Run: ``pytest tests/benchmarks/bench_image_calibration.py --benchmark-only -s``. STARTS=183 in the environment
repeats the published study's number of starts; the default is a few, three for the published method.
"""

import os
import time

import numpy as np
import pytest
from crossing_scenes import centre_error_mm, crossing_sweeps, displaced

from calibration.images import ImageSettings, calibrate_crossing, prepare
from speckle3d.core.errors import InsufficientDataError

STARTS = int(os.environ.get("STARTS", "6"))
METHODS = ("gauss-newton", "nelder-mead")
SAME_MM = 0.5


@pytest.fixture(scope="module")
def scene():
    first, second, truth = crossing_sweeps(0, frames=60)
    return prepare(first, second), truth, first.grid


def study(scene, method, starts):
    """Errors of the image's centre, seconds and how many had an answer, over random starts."""
    crossing, truth, grid = scene
    rng = np.random.default_rng(0)
    errors, seconds = [], []
    for _ in range(starts):
        start = displaced(truth, rng)
        begun = time.perf_counter()
        try:
            found = calibrate_crossing(crossing, start, ImageSettings(method=method)).sensor_from_image
            errors.append(centre_error_mm(found, truth, grid))
        except InsufficientDataError:
            errors.append(np.full(3, np.inf))
        seconds.append(time.perf_counter() - begun)
    return np.array(errors), np.array(seconds)


def described(method, errors, seconds):
    distance = np.linalg.norm(errors, axis=1)
    middle = np.median(errors, axis=0)
    with np.errstate(invalid="ignore"):
        same = (np.linalg.norm(errors - middle, axis=1) < SAME_MM).mean()
    axes = " ".join(f"{value:+.2f}" for value in middle)
    return (
        f"{method:13s} {100 * same:4.0f} % reach the same answer, centre {np.median(distance):.2f} mm median "
        f"({axes} along x, y, z), {np.median(seconds):5.1f} s each"
    )


def test_both_methods_from_far_starts(benchmark, scene):
    crossing, truth, _ = scene
    near = displaced(truth, np.random.default_rng(0), 2.0, 2.0)
    for method in METHODS:  # compiled and the images blurred before any clock runs
        calibrate_crossing(crossing, near, ImageSettings(method=method))
    benchmark.pedantic(calibrate_crossing, (crossing, near), rounds=3)
    print(f"\n{STARTS} starts, each parameter within 20 mm and 20 degrees:")
    fast = study(scene, "gauss-newton", STARTS)
    print(described("gauss-newton", *fast))
    published = study(scene, "nelder-mead", min(STARTS, 3))
    print(described("nelder-mead", *published))
    ratio = np.median(published[1]) / np.median(fast[1])
    print(f"nelder-mead takes {ratio:.1f} times as long ({len(published[1])} starts)")
