"""Covariance where residuals come in clusters, against leaving each cluster out and against repetition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.leastsquares import clustered_covariance, correlated_lags


def residuals_of(design, y):
    return design @ np.linalg.lstsq(design, y)[0] - y


def leaving_out(design, y, cluster):
    """Spread of the answers without each cluster about the answer with all."""
    everything = np.linalg.lstsq(design, y)[0]
    moved = [
        np.linalg.lstsq(design[cluster != one], y[cluster != one])[0] - everything
        for one in np.unique(cluster)
    ]
    return np.transpose(moved) @ np.array(moved)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(1e-3, 1e3),
    rows=st.integers(1, 3),
    shuffled=st.booleans(),
)
def test_it_is_what_leaving_each_cluster_out_says(seed, scale, rows, shuffled):
    rng = np.random.default_rng(seed)
    # Several points to a cluster, of different number, and several residuals to a point.
    cluster = np.repeat(np.arange(12) * 7, rng.integers(1, 5, 12))
    if shuffled:
        cluster = rng.permutation(cluster)
    design = rng.normal(size=(rows * len(cluster), 3)) * [1.0, scale, 1.0]
    y = rng.normal(size=len(design))
    found = clustered_covariance(design, residuals_of(design, y), cluster, lags=0)
    expected = leaving_out(design, y, np.repeat(cluster, rows))
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), rtol=1e-6, atol=1e-8
    )


def test_independent_residuals_have_the_usual_covariance():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(200, 3))
    usual = np.linalg.inv(design.T @ design)
    found = []
    for _ in range(200):
        y = rng.normal(size=200)
        found.append(clustered_covariance(design, residuals_of(design, y), np.arange(200), lags=0))
    # Leaving a residual of leverage h out makes it 1 / (1 - h) times as large on average: 3 / 200, and more
    # where it counts.
    leverage = np.einsum("ij,jk,ik->i", design, usual, design)
    expected = usual @ (design.T / (1.0 - leverage)) @ design @ usual
    np.testing.assert_allclose(expected, usual, atol=0.03 * usual.max())
    # One of them errs by an eighth, the mean of 200 by 0.9 %; three times that.
    np.testing.assert_allclose(np.mean(found, axis=0), expected, atol=0.027 * usual.max())
    assert np.std([one[0, 0] for one in found]) < 0.25 * usual[0, 0]


def test_what_clusters_share_is_not_taken_for_many_pieces_of_evidence():
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(80), 4)
    design = np.column_stack([np.ones(320), np.repeat(rng.normal(size=80), 4)])
    answers, claims, naive = [], [], []
    for _ in range(300):
        y = np.repeat(rng.normal(size=80), 4) + 0.3 * rng.normal(size=320)
        residuals = residuals_of(design, y)
        answers.append(np.linalg.lstsq(design, y)[0])
        claims.append(np.diag(clustered_covariance(design, residuals, cluster, lags=0)))
        naive.append(np.diag(np.linalg.inv(design.T @ design)) * np.mean(residuals**2))
    actual = np.var(answers, axis=0)
    # 300 know a variance to 8 %; three times that.
    np.testing.assert_allclose(np.mean(claims, axis=0) / actual, 1.0, atol=0.25)
    # Four points that move together look like four: nearly half the standard error.
    assert (np.mean(naive, axis=0) < 0.35 * actual).all()


def drifting(rng, count, persistence):
    """First-order autoregressive noise of unit variance."""
    y = np.empty(count)
    y[0] = rng.normal()
    for k in range(1, count):
        y[k] = persistence * y[k - 1] + np.sqrt(1 - persistence**2) * rng.normal()
    return y


def test_drift_from_cluster_to_cluster_makes_a_mean_less_certain():
    rng = np.random.default_rng(2)
    design, frame = np.ones((400, 1)), np.arange(400)
    means, claims, blind = [], [], []
    for _ in range(200):
        y = drifting(rng, 400, 0.8)
        residuals = residuals_of(design, y)
        means.append(y.mean())
        claims.append(clustered_covariance(design, residuals, frame)[0, 0])
        blind.append(clustered_covariance(design, residuals, frame, lags=0)[0, 0])
    actual = np.var(means)
    # (1 + .8) / (1 - .8) = 9 times the variance of independent ones.
    assert actual / np.mean(blind) == pytest.approx(9.0, rel=0.25)
    # Weights that fall with the lag, and lags that end where chance begins, leave some of it out.
    assert 0.6 * actual < np.mean(claims) < 1.1 * actual


def test_independent_clusters_are_rarely_taken_for_correlated():
    rng = np.random.default_rng(3)
    lags = np.array([correlated_lags(rng.normal(size=300), np.arange(300)) for _ in range(400)])
    # Two standard deviations on one side: one in forty.
    assert np.mean(lags > 0) < 0.06
    assert lags.max() <= 3


def test_lags_reach_as_far_as_the_correlation():
    rng = np.random.default_rng(4)
    moving = np.convolve(rng.normal(size=2004), np.ones(5) / 5.0, mode="valid")
    assert correlated_lags(moving, np.arange(2000)) == pytest.approx(4, abs=1)
    # Residuals of one cluster are one in time, however many.
    assert correlated_lags(np.repeat(moving, 4), np.repeat(np.arange(2000), 2)) == pytest.approx(4, abs=1)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), lags=st.integers(0, 60))
def test_it_stays_a_covariance_whatever_the_lags(seed, lags):
    rng = np.random.default_rng(seed)
    design, y = rng.normal(size=(40, 4)), rng.normal(size=40)
    found = clustered_covariance(design, residuals_of(design, y), np.arange(40), lags)
    np.testing.assert_allclose(found, found.T, atol=1e-12)
    assert np.linalg.eigvalsh(found).min() > -1e-12


def test_directions_that_nothing_determines_do_no_harm():
    rng = np.random.default_rng(5)
    design = np.column_stack([rng.normal(size=60), np.zeros(60)])
    found = clustered_covariance(design, rng.normal(size=60), np.repeat(np.arange(20), 3), lags=0)
    assert np.isfinite(found).all()
    assert found[1, 1] == 0.0
