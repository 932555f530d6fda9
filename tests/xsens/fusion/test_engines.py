"""Every engine on one known movement: axes of the world, clocks, holes, claims; and on a trial of BROAD."""

import sys

import numpy as np
import pytest
from broad import coverage, estimate, read_trial, trials_in
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from xsens.fusion.orient import orient
from xsens.fusion.settings import Method
from xsens.logs.samples import ImuLog

RATE_HZ = 100.0
VQFS = [Method.vqf_online, Method.vqf]
BIAS_RAD_S = np.deg2rad([0.2, -0.1, 0.3])
SETTLED_S = 12.0
"""VQF averages the first fields over 9 s."""


def swung(time_s, seed=7):
    """A sensor 40 degrees west of north, at rest for 4 s, then swung about all axes; noise, a steady bias."""
    rng = np.random.default_rng(seed)

    def pose(at_s):
        t = np.clip(at_s - 4.0, 0.0, None)
        return Rotation.from_euler(
            "ZYX", np.column_stack([0.7 + np.sin(1.3 * t), 0.5 * np.sin(2.1 * t), 0.7 * np.sin(1.7 * t)])
        )

    truth = pose(time_s)
    # The mean rate between samples, however far apart they are: a gyroscope sums all there is.
    step = np.diff(time_s, prepend=time_s[0] - 1 / RATE_HZ)
    rate = (pose(time_s - step).inv() * truth).as_rotvec() / step[:, None] + BIAS_RAD_S
    force = truth.inv().apply([0.0, 0.0, 9.80665])
    field = truth.inv().apply([0.5, 0.0, -0.86])
    noisy = [
        x + sd * rng.standard_normal(x.shape) for x, sd in ((force, 0.05), (rate, 0.005), (field, 0.005))
    ]
    return truth, ImuLog(time_s, *noisy)


def even(seconds=30.0, rate_hz=RATE_HZ):
    return np.arange(1, round(seconds * rate_hz) + 1) / rate_hz


def error_deg(truth, found, after_s=SETTLED_S):
    late = found.rotations.time_s > after_s
    return np.rad2deg((found.rotations.world_from_sensor * truth.inv()).magnitude()[late])


@pytest.mark.parametrize("method", Method)
def test_every_engine_finds_north_west_up(method):
    truth, log = swung(even())
    found = orient(log, method=method.value)
    assert found.method is method
    # A mix-up of worlds is 90 degrees; the noise of the field alone 0.6 a sample, averaged over seconds.
    assert error_deg(truth, found).max() < 1.5
    assert np.linalg.norm(found.gyro_bias_rad_s[-1] - BIAS_RAD_S) < np.deg2rad(0.1)
    assert not found.disturbed[-1]
    assert found.notes == ()


def only(log, kept):
    """The log without the samples that were lost."""
    vectors = (log.accelerometer_m_s2, log.gyroscope_rad_s, log.magnetometer_au)
    return ImuLog(log.time_s[kept], *(values[kept] for values in vectors))


@pytest.mark.parametrize("method", Method)
def test_lost_samples_cost_little(method):
    truth, log = swung(even())
    kept = (np.arange(len(log)) + 12) % 25 >= 8  # holes of 0.09 s
    found = orient(only(log, kept), method=method)
    assert len(found) == kept.sum()
    assert all("even clock" in note for note in found.notes)
    # Measured 0.4 to 0.7; 1.9 to 2.4 where the reading after a hole is taken for all of it.
    assert error_deg(truth[kept], found).max() < 1.2


@pytest.mark.parametrize("method", VQFS)
@pytest.mark.parametrize("clock", ["uneven", "bursts"])
def test_a_clock_that_is_not_even_costs_little(method, clock):
    time_s = even()
    if clock == "uneven":
        time_s = time_s + np.random.default_rng(2).uniform(-0.3, 0.3, time_s.size) / RATE_HZ
    else:
        time_s = (time_s.reshape(-1, 4)[:, :1] + 1e-3 * np.arange(4)).ravel()
    truth, log = swung(time_s)
    found = orient(log, method=method)
    assert error_deg(truth, found).max() < 1.5
    assert [note for note in found.notes if f"even clock: {time_s.size} samples" in note] == [*found.notes]
    assert len(found.notes) == 1


def test_a_python_without_vqf_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "vqf", None)
    _, log = swung(even(1.0))
    assert len(orient(log, method="filter")) == 100
    with pytest.raises(InvalidInputError, match=r"pip install vqf.*smoother"):
        orient(log, method="vqf")


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("method", VQFS)
def test_vqf_does_not_claim_too_little(realdata, method):
    held = []
    for name in trials_in(realdata / "broad"):
        log, true, moving = read_trial(realdata / "broad", name)
        scored = moving & (np.arange(len(log)) % 4 == 0)
        # The cameras' north is not the magnetometer's: a constant heading is no error of VQF.
        held.append(coverage(estimate(log, method), true, scored, steady=True))
    held = np.array(held)
    # Of normal errors 68 % are within one sigma, which a dozen trials tell to 8; of heading and inclination.
    assert held[:, [0, 2]].mean(axis=0).min() >= 0.6
    # RMS error over RMS sigma of the worst trial.
    assert held[:, [1, 3]].max() <= 2.0
