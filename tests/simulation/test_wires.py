"""A scan of two crossing threads, and the one mounting of all presets."""

from functools import cache

import numpy as np
import pytest
from scipy.signal import hilbert

from speckle3d.simulation.presets import SimulationSettings, simulate

CROSSING_MM = (320.0, -150.0, -240.0)
"""Where the threads cross, in the tracker's world."""

MOUNTED = ("phantom", "tissue", "reversal", "rotation", "crossed")


@cache
def made(**settings):
    """The sweep of some settings, made once for all tests; nothing may change it."""
    return simulate(SimulationSettings(**{"vectors": 16, "samples": 600, "frames": 4, **settings}))[0]


@pytest.mark.parametrize("preset", MOUNTED)
@pytest.mark.parametrize("scan", ["plane", "wires"])
def test_a_calibration_scan_has_the_mounting_of_every_sweep(scan, preset):
    scanned, sweep = made(preset=scan), made(preset=preset, seed=5).sweep
    assert scanned.sweep.tracker.sensor_from_image is None
    assert scanned.sweep.orientation.sensor_from_image is None
    np.testing.assert_array_equal(
        scanned.tracker_from_image.as_matrix(), sweep.tracker.sensor_from_image.as_matrix()
    )
    turned = scanned.orientation_from_image * sweep.orientation.sensor_from_image.inv()
    assert turned.magnitude() < 1e-12


def test_the_crossing_echoes_where_the_truth_says():
    sweep = made(preset="wires", vectors=64, samples=3818, frames=6, seed=11, snr_db=60.0).sweep
    at = sweep.truth.inv().apply(CROSSING_MM)
    for frame, (lateral, depth, off) in zip(sweep.frames, at, strict=True):
        assert abs(off) < 0.3  # the hand's reach and its tremor
        echo = np.abs(hilbert(np.asarray(frame, float), axis=1))
        column = round(lateral / sweep.grid.vector_pitch_mm)
        row = round(depth / sweep.grid.sample_spacing_mm)
        near = echo[max(column - 2, 0) : column + 3, row - 40 : row + 40]
        # Only threads seen along their length come near the crossing's echo, where two of them add up.
        assert near.max() > 0.5 * echo.max()
        assert near.max() > 30.0 * np.median(echo)
