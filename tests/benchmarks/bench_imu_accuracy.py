"""Accuracy of an orientation sensor: 25 calibrations x 77 orientations, against composing every rotation.

Run: ``pytest tests/benchmarks/bench_imu_accuracy.py --benchmark-only -s``. Medians, in the same process.
"""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.core.geometry import rotation_from_fixed_angles
from xsens.accuracy.angles import AccuracyTable, pair_errors

CALIBRATION_SD_DEG = (1.50, 1.10, 0.08)
"""Tilt, yaw and roll: table 1 of Housden et al., 2008."""

SENSOR_SD_DEG = (0.1, 0.5, 0.1)
"""Of one reading about north, west and up; the MT9-B's claim is less than 0.5 degrees in roll and pitch."""


@pytest.fixture(scope="module")
def experiment():
    """Eleven tilts at each of seven yaws, noisy readings, calibrations as precise as the published ones."""
    rng = np.random.default_rng(0)
    yaw, tilt = np.meshgrid(np.linspace(-5.5, 5.5, 7), np.linspace(-16.4, 2.2, 11), indexing="ij")
    reference = rotation_from_fixed_angles(0.0, np.deg2rad(yaw).ravel(), np.deg2rad(tilt).ravel())
    spread = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(CALIBRATION_SD_DEG), (25, 3)))
    noise = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(SENSOR_SD_DEG), (77, 3)))
    return noise * reference, reference, spread


def composed(readings, reference, calibrations):
    """The same errors with every image's orientation and every pair's turn composed."""
    first, second = np.triu_indices(len(reference), 1)
    right = (reference[first].inv() * reference[second]).as_rotvec()
    errors = []
    for calibration in calibrations:
        image = readings * calibration
        errors.append((image[first].inv() * image[second]).as_rotvec() - right)
    return np.array(errors)[..., ::-1]


def median_seconds(function, rounds=11):
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def test_all_pairs_and_calibrations(benchmark, experiment):
    errors = benchmark(pair_errors, *experiment)
    np.testing.assert_allclose(errors.error_rad, composed(*experiment), atol=1e-12)
    ours = median_seconds(lambda: AccuracyTable.of({"simulated": pair_errors(*experiment)}))
    theirs = median_seconds(lambda: composed(*experiment))
    print(
        f"\n{len(errors)} errors with their table in {1e3 * ours:.1f} ms; composing every rotation takes "
        f"{1e3 * theirs:.0f} ms, {theirs / ours:.1f} times as long\n"
        + AccuracyTable.of({"simulated": errors}).text()
    )
