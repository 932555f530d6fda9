"""The inclination's kernels against the same filter and smoother step by step with NumPy and SciPy."""

import fusion_twin as twin
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from speckle3d.kernels.orientation.inclination import GOES_ON
from xsens.fusion.inclination import forward, fresh_filter, smooth, within_steps
from xsens.fusion.samples import Samples
from xsens.fusion.settings import FusionSettings

RATE_HZ, SECONDS = 50.0, 30.0
SETTINGS = FusionSettings()


def stretch(seed):
    """A hand's movement with a rest, an irregular clock, lost samples and gaps in the field."""
    rng = np.random.default_rng(seed)
    count = int(RATE_HZ * SECONDS)
    time_s = np.arange(count) / RATE_HZ
    moving = (np.sin(0.35 * time_s) > -0.5)[:, None]
    rate = moving * np.stack([1.2 * np.sin(a * time_s + b) for a, b in ((1.7, 0), (1.1, 1), (2.3, 2))], 1)
    steps = Rotation.from_rotvec(rate / RATE_HZ)
    turns = [Rotation.from_rotvec([0.2, -0.1, 2.0])]
    for step in steps[1:]:
        turns.append(turns[-1] * step)
    sensor_from_world = Rotation.concatenate(turns).inv()
    force = sensor_from_world.apply([0.0, 0.0, 9.81]) + 0.4 * moving * rng.standard_normal((count, 3))
    field = sensor_from_world.apply([0.45, 0.0, -0.9]) + 0.01 * rng.standard_normal((count, 3))
    field[rng.random(count) < 0.4] = np.nan
    gyroscope = rate + [0.01, -0.005, 0.008] + 0.005 * rng.standard_normal((count, 3))
    kept = rng.random(count) > 0.05
    step_s = np.diff(time_s[kept] + rng.uniform(0.0, 0.2, kept.sum()) / RATE_HZ, prepend=-1.0 / RATE_HZ)
    return Samples(step_s, gyroscope[kept], force[kept], field[kept])


def matrices(steps, name):
    return Rotation.concatenate([getattr(step, name) for step in steps]).as_matrix()


def assert_same_rotations(found, expected):
    assert np.rad2deg(np.linalg.norm(found - expected, axis=(1, 2)).max()) < 1e-7


def assert_same_covariances(found, expected):
    """Each number as a fraction of the deviations it belongs to."""
    sd = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    assert (np.abs(found - expected) / (sd[:, :, None] * sd[:, None, :])).max() < 1e-6


@pytest.mark.parametrize("heading_apart", [False, True])
def test_the_filter_takes_the_plain_filters_steps(heading_apart):
    samples = stretch(1)
    # A stretch with samples left over, another after a pause, and that one's continuation piece by piece.
    parts = [(samples[:1003], 0.0), (samples[1003:1305], 0.7)]
    parts += [(samples[k : k + 3], GOES_ON) for k in range(1305, 1400, 3)]
    plain, kept = twin.LevelFilter(SETTINGS, heading_apart), fresh_filter(SETTINGS)
    rests, blind = 0, False
    for part, pause_s in parts:
        steps = forward(part, SETTINGS, kept, pause_s, covariances=True, heading_apart=heading_apart)
        expected = plain.run(part, steps.last, None if pause_s == GOES_ON else pause_s)
        assert_same_rotations(steps.start, matrices(expected, "start"))
        assert_same_rotations(steps.predicted, matrices(expected, "predicted"))
        assert_same_rotations(steps.corrected, matrices(expected, "after"))
        np.testing.assert_allclose(steps.start_bias_rad_s, [e.start_bias for e in expected], atol=1e-10)
        np.testing.assert_allclose(steps.bias_rad_s, [e.bias for e in expected], atol=1e-10)
        np.testing.assert_allclose(steps.rate_rad_s, [e.increment.rate for e in expected], rtol=1e-9)
        np.testing.assert_allclose(steps.field_au, [e.increment.field for e in expected], rtol=1e-9)
        assert_same_covariances(steps.covariance, np.array([e.covariance for e in expected]))
        sd = np.sqrt([np.diag(e.covariance)[:6] for e in expected])
        np.testing.assert_allclose(np.hstack([steps.sd_rad, steps.bias_sd_rad_s]), sd, rtol=1e-6)
        assert (steps.resting == [e.resting for e in expected]).all()
        assert (steps.started == [e.started for e in expected]).all()
        rests += steps.resting.sum()
        blind = blind or np.isnan(steps.field_au).any()
    assert rests > 50
    assert blind


def test_the_smoother_finds_what_the_plain_one_finds():
    samples = stretch(2)[:1203]
    steps, found = smooth(samples, SETTINGS)
    plain = twin.LevelFilter(SETTINGS).run(samples, steps.last, 0.0)
    expected = twin.smoothed(plain)
    assert_same_rotations(found.matrices, expected.matrices)
    np.testing.assert_allclose(found.bias_rad_s, expected.bias, atol=1e-10)
    np.testing.assert_allclose(found.sd_rad, expected.sd, rtol=1e-6)
    np.testing.assert_allclose(found.bias_sd_rad_s, expected.bias_sd, rtol=1e-6)
    biases = found.bias_rad_s[:-1]
    for ends in (None, found.matrices[1:]):
        within = within_steps(steps, found.matrices[:-1], biases, ends)
        each = [
            carried(*row, None if ends is None else ends[k])
            for k, row in enumerate(zip(plain, found.matrices[:-1], biases, strict=True))
        ]
        assert_same_rotations(Rotation.from_quat(within).as_matrix(), np.concatenate(each))


def carried(step, start, bias, end):
    """Orientation of a step's samples by the gyroscope; what is off at its end is spread over the step."""
    increment = step.increment
    turned = Rotation.from_matrix(np.tile(start, (len(increment.time_s), 1, 1)))
    if not step.resting:
        late = Rotation.from_rotvec(np.outer(increment.time_s, increment.assumed - bias))
        turned = turned * increment.turns * late
    if end is not None:
        off = (Rotation.from_matrix(end) * turned[-1].inv()).as_rotvec()
        turned = Rotation.from_rotvec(np.outer(increment.time_s / increment.duration_s, off)) * turned
    return turned.as_matrix()
