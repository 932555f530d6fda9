"""Kernels of the orientation filter beside NumPy, SciPy and filterpy, and beside their own derivatives."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t

from speckle3d.kernels import heading_arrays as at
from speckle3d.kernels import orientation_arrays as places
from speckle3d.kernels.heading import find_headings
from speckle3d.kernels.increments import sum_samples
from speckle3d.kernels.orientation_smoothing import _rauch
from xsens.fusion.heading import FREEDOM, FieldModel, HeadingBank, _transitions
from xsens.fusion.settings import FusionSettings

MODEL = FieldModel(0.05)


def covariance(rng, size, sd=0.1):
    root = sd * rng.standard_normal((size, size))
    return root @ root.T + sd * sd * np.eye(size)


def a_bin(rng, seen):
    """A bin of a moving sensor whose level axes were not corrected."""
    row = np.zeros(at.BIN)
    row[at.SPAN], row[at.SEEN], row[at.SLIP], row[at.BIAS_VARIANCE], row[at.TILT] = (
        0.25,
        seen,
        1e-5,
        1e-6,
        1e-4,
    )
    row[at.READING : at.READING + 3] = [0.4, 0.1, -0.9]
    row[at.POSE : at.POSE + 9] = Rotation.random(rng=rng).as_matrix().ravel()
    row[at.LATE : at.LATE + 3] = rng.standard_normal(3)
    row[at.CORRECTION : at.CORRECTION + 9] = np.eye(3).ravel()
    return row


def a_state(rng):
    state = 0.02 * rng.standard_normal(at.STATES)
    state[at.OF_ROOM : at.OF_ROOM + 3] += [0.4, 0.1, -0.9]
    state[at.GYRO_BIAS : at.GYRO_BIAS + 3] = 0.0
    return state


def run(row, state, p):
    """State, covariance and what was found after one bin of one model's filter that has begun."""
    bank = HeadingBank(FusionSettings(), (MODEL,))
    flags = np.zeros((1, at.FLAGS))
    flags[0, [at.BEGUN, at.RAN]] = 1.0
    x, p, found = state[None].copy(), p[None].copy(), np.empty((1, 1, at.FOUND))
    none = np.empty((0, 1, at.STATES)), *(np.empty((0, 1, at.STATES, at.STATES)) for _ in range(2))
    find_headings(row[None], bank._table, bank._shared, x, p, flags, found, *none)
    return x[0], p[0], found[0, 0]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_smoothers_transition_is_the_derivative_of_the_filters_prediction(seed):
    rng = np.random.default_rng(seed)
    row, state = a_bin(rng, seen=0.0), a_state(rng)
    any_p = covariance(rng, at.STATES)
    ends = [
        run(row, state + step, any_p)[0] for step in 1e-6 * np.vstack([np.eye(at.STATES), -np.eye(at.STATES)])
    ]
    numeric = (np.array(ends[: at.STATES]) - np.array(ends[at.STATES :])).T / 2e-6
    transition = _transitions(np.array([row, row]), MODEL, state[None])[1]
    np.testing.assert_allclose(transition, numeric, atol=1e-8)
    # Noise is what is left of the covariance, whatever that was.
    several = (any_p, covariance(rng, at.STATES))
    noises = [run(row, state, p)[1] - transition @ p @ transition.T for p in several]
    np.testing.assert_allclose(noises[0], noises[1], atol=1e-14)
    assert np.linalg.eigvalsh(noises[0]).min() > -1e-14


@pytest.mark.parametrize("off", [0.02, 3.0])
def test_a_reading_corrects_as_by_kalmans_equations_with_students_errors(off):
    rng = np.random.default_rng(3)
    row, state, p = a_bin(rng, seen=1.0), a_state(rng), covariance(rng, at.STATES)
    x, predicted, _ = run(np.where(np.arange(at.BIN) == at.SEEN, 0.0, row), state, p)
    shows = np.zeros((3, at.STATES))
    for first in (at.OF_ROOM, at.OF_PLACE, at.OF_STRAY):
        shows[:, first : first + 3] = np.eye(3)
    shows[:, at.IRON : at.IRON + 3] = row[at.POSE : at.POSE + 9].reshape(3, 3)
    shows[:, at.OF_LAG] = row[at.LATE : at.LATE + 3]
    row[at.READING : at.READING + 3] = shows @ x + off * np.array([0.6, -0.64, 0.48])
    tilted = np.cross(np.eye(3)[:2], x[at.OF_ROOM : at.OF_ROOM + 3])
    white = FusionSettings().field_noise_sqrt_s ** 2 / row[at.SPAN]
    noise = white * np.eye(3) + row[at.TILT] * np.diag((tilted**2).sum(axis=0))
    spread, residual = shows @ predicted @ shows.T + noise, row[at.READING : at.READING + 3] - shows @ x
    trust = min(1.0, (FREEDOM + 3.0) / (FREEDOM + residual @ np.linalg.solve(spread, residual)))
    twin = KalmanFilter(at.STATES, 3)
    twin.x, twin.P = x[:, None], predicted
    twin.update(
        residual[:, None] + shows @ twin.x,
        R=noise + (1 / trust - 1) * spread.trace() / 3 * np.eye(3),
        H=shows,
    )
    found_x, found_p, out = run(row, state, p)
    np.testing.assert_allclose(found_x, twin.x[:, 0], atol=1e-12)
    np.testing.assert_allclose(found_p, twin.P, atol=1e-12)
    assert out[at.TRUST] == pytest.approx(trust)
    assert (trust == 1.0) == (off < 1.0)
    density = multivariate_t.logpdf(residual, None, spread, FREEDOM)
    assert out[at.EVIDENCE] - 1.5 * np.log(np.pi) == pytest.approx(density, abs=1e-9)


def test_a_step_back_is_filterpys():
    rng = np.random.default_rng(4)
    p, after, transition = (
        covariance(rng, 9),
        covariance(rng, 9),
        np.eye(9) + 0.1 * rng.standard_normal((9, 9)),
    )
    noise = rng.uniform(0.01, 0.1, 9)
    steps = np.array([transition, transition])
    _, smoothed, gains, _ = KalmanFilter(9, 3).rts_smoother(
        np.zeros((2, 9)), np.array([p, after]), steps, np.array([np.diag(noise)] * 2)
    )
    gain, predicted, wide = np.empty((3, 9, 9))
    _rauch(transition, noise, p, after, gain, predicted, wide)
    np.testing.assert_allclose(gain.T, gains[0], atol=1e-12)
    np.testing.assert_allclose(p, smoothed[0], atol=1e-12)


def test_samples_are_summed_with_the_attitude_in_their_middle():
    rng = np.random.default_rng(5)
    step_s = rng.uniform(0.005, 0.02, 8)
    rate, force, field = rng.standard_normal((3, 8, 3))
    field[3] = np.nan
    step, within = np.zeros(places.STEP), np.zeros((8, places.SAMPLE))
    step[places.ASSUMED : places.ASSUMED + 3] = bias = 0.1 * rng.standard_normal(3)
    sum_samples(step_s, rate, force, field, 0, 8, 1.0, step, within)
    turn, speed, fields = Rotation.identity(), np.zeros(3), []
    for k in range(8):
        half = Rotation.from_rotvec(0.5 * (rate[k] - bias) * step_s[k])
        speed += (turn * half).apply(force[k]) * step_s[k]
        turn = turn * half * half
        fields.append(turn.apply(field[k]))
    np.testing.assert_allclose(
        step[places.TURN : places.TURN + 9].reshape(3, 3), turn.as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(step[places.FORCE : places.FORCE + 3], speed, atol=1e-12)
    np.testing.assert_allclose(step[places.FIELD : places.FIELD + 3], np.nanmean(fields, axis=0), atol=1e-12)
    np.testing.assert_allclose(step[places.RATE : places.RATE + 3], step_s @ rate / step_s.sum(), atol=1e-12)
    assert step[places.DURATION] == pytest.approx(step_s.sum())
    assert step[places.BRIDGED] == 0.0
