"""Line detection: frames per second, and all-pairs consensus against scikit-image's RANSAC on the same edges.

Run: ``pytest tests/benchmarks/bench_lines.py --benchmark-only -s``. Medians, in the same process.
"""

import time

import numpy as np
import pytest
from skimage import measure

from calibration.detection.edges import first_echoes, take_profiles
from calibration.detection.lines import detect_lines
from calibration.detection.region import lay_columns
from speckle3d.kernels.lines import consensus_line

FRAMES, SHAPE, PIXEL_MM = 700, (640, 480), (0.08, 0.1)
TOLERANCE_ROWS, TRIALS = 5.0, 100


@pytest.fixture(scope="module")
def frames():
    """Speckled bands on noise, at another depth and slope in each frame; forty different, over and over."""
    rng = np.random.default_rng(0)
    column, row = np.ogrid[: SHAPE[0], : SHAPE[1]]
    kinds = []
    for _ in range(40):
        depth, slope = rng.uniform(120, 350), rng.uniform(-0.15, 0.15)
        at = depth + slope * (column - SHAPE[0] / 2)
        band = np.exp(-(((row - at) / 6.0) ** 2)) * rng.uniform(80, 250, (SHAPE[0], 1))
        # A fifth of the columns see something above the floor, as dust is seen, or not the floor.
        band[rng.random(SHAPE[0]) < 0.1] = 0.0
        for x in rng.choice(SHAPE[0], SHAPE[0] // 10, replace=False):
            band[x, rng.integers(20, 100) :][:12] = 250.0
        kinds.append((band + rng.integers(0, 30, SHAPE)).clip(0, 255).astype(np.uint8))
    return np.array(kinds)[np.arange(FRAMES) % 40]


def median_seconds(function, *arguments, rounds=5):
    """Median time of a few rounds after one to compile and warm up."""
    function(*arguments)
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def test_frames_per_second(benchmark, frames):
    found = benchmark.pedantic(detect_lines, (frames, PIXEL_MM), rounds=3, warmup_rounds=1)
    assert found.dropped == {}
    seconds = median_seconds(detect_lines, frames, PIXEL_MM, rounds=3)
    print(f"\n{FRAMES} frames of {SHAPE[0]} x {SHAPE[1]} in {seconds:.2f} s: {FRAMES / seconds:.0f} frames/s")


def test_consensus_against_scikit_image(benchmark, frames):
    columns = lay_columns(SHAPE, 60, None)
    column = columns.column.astype(float)
    edges = []
    for image in frames[:40]:
        profiles = take_profiles(image[columns.column].astype(np.float32), columns, 7.0)
        edges.append(first_echoes(profiles, profiles.slope, 3.0, "front").row)

    def ours():
        agree = np.empty(column.size, bool)
        return [consensus_line(column, row, columns.inside, TOLERANCE_ROWS, agree) for row in edges]

    def theirs():
        points = [np.stack([column, row], axis=1)[np.isfinite(row)] for row in edges]
        return [
            measure.ransac(each, measure.LineModelND, 2, TOLERANCE_ROWS, max_trials=TRIALS, rng=0)
            for each in points
        ]

    benchmark(ours)
    a, b = median_seconds(ours) / len(edges), median_seconds(theirs, rounds=3) / len(edges)
    pairs = column.size * (column.size - 1) // 2
    print(
        f"\nconsensus of {column.size} edges: all {pairs} pairs in {1e3 * a:.2f} ms, scikit-image's ransac\n"
        f"with {TRIALS} random pairs in {1e3 * b:.1f} ms: {b / a:.0f} times its speed, "
        f"{b / TRIALS / a * pairs:.0f} times pair for pair"
    )
