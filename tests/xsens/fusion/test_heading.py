"""The heading's kernels against the same filter with full matrices, and cases whose answer is known."""

import heading_twin as twin
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from speckle3d.kernels import heading_arrays as at
from xsens.fusion.heading import (
    MEMORY_S,
    FieldModel,
    HeadingBank,
    _backward,
    bins_of,
    steps_per_bin,
)
from xsens.fusion.inclination import forward, fresh_filter
from xsens.fusion.samples import Samples
from xsens.fusion.settings import FusionSettings

RATE_HZ = 50.0
EARTH = np.array([18.0, 0.0, -45.0])
SETTINGS = FusionSettings()
MODELS_OF_EACH_KIND = (
    FieldModel(0.02),
    FieldModel(0.05, stray_s=8.0, handicap=3.0),
    FieldModel(0.03, after_s=5.0, handicap=2.0),
    FieldModel(0.02, iron=0.02, iron_put_on=0.15, handicap=5.0),
    FieldModel(0.03, iron=0.7, iron_put_on=0.15, handicap=5.0),
)


def turned(seconds, seed, rests=True):
    """Samples of a sensor that is turned about all axes, with rests; its truth; and the source of chance."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    moving = (np.sin(0.5 * time_s) > -0.6) | (not rests)
    moved_s = np.cumsum(moving) / RATE_HZ
    angles = np.column_stack([np.sin(1.3 * moved_s), 0.9 * np.sin(0.7 * moved_s), np.sin(1.1 * moved_s)])
    truth = Rotation.from_euler("ZYX", 1.2 * angles)
    rate = (truth[:-1].inv() * truth[1:]).as_rotvec() * RATE_HZ
    rate = (
        np.vstack([rate[:1], rate]) + [0.004, -0.003, 0.005] + 0.003 * rng.standard_normal((len(time_s), 3))
    )
    force = truth.inv().apply([0.0, 0.0, 9.80665]) + 0.03 * rng.standard_normal((len(time_s), 3))
    force += 0.2 * moving[:, None] * rng.standard_normal((len(time_s), 3))
    return Samples(np.full(len(time_s), 1 / RATE_HZ), rate, force, np.full_like(rate, np.nan)), truth, rng


def with_field(samples, field):
    return Samples(samples.step_s, samples.rate_rad_s, samples.force_m_s2, field)


def eventful(seed=5, seconds=36.0):
    """A recording with iron put on at half time, missing readings, spikes and a field that strays."""
    samples, truth, rng = turned(seconds, seed)
    time_s = np.arange(len(samples)) / RATE_HZ
    stray = np.cumsum(rng.standard_normal((len(samples), 3)), axis=0) * 0.1
    field = truth.inv().apply(EARTH + stray) + 0.3 * rng.standard_normal((len(samples), 3))
    field += np.outer(time_s > 0.5 * seconds, [8.0, -5.0, 3.0])
    field[(time_s % 7.0 > 3.0) & (time_s % 7.0 < 4.1)] = np.nan
    field[(time_s > 12.0) & (time_s < 12.6)] += 40.0
    field[time_s < 0.5] = np.nan
    return with_field(samples, field)


def filtered(samples, kept=None, pause_s=0.0, corrected=True):
    """Steps of the inclination's filter, and bins of them."""
    kept = fresh_filter(SETTINGS) if kept is None else kept
    steps = forward(samples, SETTINGS, kept, pause_s, heading_apart=True)
    args = (steps.start, steps.bias, steps.bias_sd_rad_s, steps.sd_rad, SETTINGS)
    return steps, bins_of(steps, *args, corrected=corrected)


def norm_of(bins):
    first = np.flatnonzero(bins[:, at.SEEN] > 0.0)[0]
    return np.linalg.norm(bins[first, at.READING : at.READING + 3])


def filled(steps, name, missing):
    """A column of the plain filters' steps, shape (bins, models)."""
    return np.array(
        [[missing if one is None else getattr(one, name) for one in row] for row in zip(*steps, strict=True)]
    )


def test_every_models_filter_takes_the_plain_filters_steps():
    _, bins = filtered(eventful())
    states, after, before, found = HeadingBank(SETTINGS, MODELS_OF_EACH_KIND).kept(bins)
    plain = [
        twin.HeadingFilter(model, SETTINGS).run(twin.bins_from(bins, norm_of(bins)))
        for model in MODELS_OF_EACH_KIND
    ]
    zeros = np.zeros((16, 16))
    np.testing.assert_allclose(found[..., at.FOUND_TURN], filled(plain, "turn", 0.0), rtol=1e-8, atol=1e-10)
    variances = filled(plain, "variance", np.pi**2)
    np.testing.assert_allclose(found[..., at.FOUND_VARIANCE], variances, rtol=1e-8)
    evidence = filled(plain, "evidence", np.nan)
    np.testing.assert_allclose(found[..., at.EVIDENCE], evidence, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found[..., at.TRUST], filled(plain, "trust", 0.0), rtol=1e-8)
    np.testing.assert_allclose(states, filled(plain, "mean", zeros[0]), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(after, filled(plain, "covariance", zeros), rtol=1e-6, atol=1e-13)
    np.testing.assert_allclose(before, filled(plain, "predicted", zeros), rtol=1e-6, atol=1e-13)
    rests = bins[:, at.RESTS] > 0.0
    assert (np.diff(rests) != 0).sum() >= 2
    assert 0 < (bins[:, at.SEEN] == 0.0).sum() < len(bins) / 2
    assert (found[bins[:, at.SEEN] > 0.0, 0, at.TRUST] < 0.1).any()
    shown = np.diff(before[:, 3, 6, 6], prepend=before[0, 3, 6, 6])
    assert (shown > 0.02).any()  # iron was found to be put on


def test_the_bank_follows_as_the_plain_filters_do_through_a_pause_and_corrections():
    samples, level = eventful(), fresh_filter(SETTINGS)
    bank = HeadingBank(SETTINGS, MODELS_OF_EACH_KIND)
    plain = [twin.HeadingFilter(model, SETTINGS) for model in MODELS_OF_EACH_KIND]
    norm, scores = None, np.full(len(plain), np.nan)
    for part, pause_s in ((samples[:1100], 0.0), (samples[1100:], 2.0)):
        if pause_s:
            bank.resume()
            for one in plain:
                one.resume()
        steps, bins = filtered(part, level, pause_s)
        norm = norm or norm_of(bins)
        biases = steps.bias[
            np.minimum(np.arange(1, len(bins) + 1) * steps_per_bin(SETTINGS), len(steps.bias)) - 1
        ]
        found = bank.follow(bins, biases)
        each = twin.bins_from(bins, norm, np.diff(biases, axis=0, prepend=biases[:1]))
        rows = [one.run(each) for one in plain]
        weights = []
        for one, evidence in zip(each, filled(rows, "evidence", np.nan), strict=True):
            scores = remembered(scores, evidence, one.span_s)
            weights.append(shares(scores - [model.handicap for model in MODELS_OF_EACH_KIND]))
        turn, sd = mixture(filled(rows, "turn", 0.0), filled(rows, "variance", np.pi**2), np.array(weights))
        assert np.abs(np.sin(found.turn_rad - turn)).max() < 1e-8
        np.testing.assert_allclose(found.sd_rad, sd, rtol=1e-7)
        believed = (np.array(weights) * filled(rows, "trust", 0.0)).sum(axis=1)
        assert (found.disturbed == (bins[:, at.SEEN] > 0.0) & (believed < 0.5)).all()
        assert found.disturbed.any()


def remembered(scores, evidence, span_s):
    """Sums of the evidence that fade; a model that comes later starts as the best so far."""
    best = np.nanmax(scores) if np.isfinite(scores).any() else 0.0
    before = np.where(np.isnan(scores), best, scores)
    fade = np.exp(-span_s / MEMORY_S)
    return np.where(np.isnan(evidence), scores, fade * before + np.nan_to_num(evidence))


def shares(scores):
    if np.isnan(scores).all():
        return np.full(len(scores), 1.0 / len(scores))
    return np.nan_to_num(softmax(np.where(np.isnan(scores), -np.inf, scores)))


def mixture(turns, variances, weights):
    """Mean and deviation of a mixture of angles that are near the best one's."""
    best = turns[np.arange(len(turns)), weights.argmax(axis=1)][:, None]
    apart = Rotation.from_euler("z", (turns - best).reshape(-1, 1)).as_rotvec()[:, 2].reshape(turns.shape)
    mean = np.average(apart, axis=1, weights=weights)
    square = np.average(variances + apart**2, axis=1, weights=weights)
    return best[:, 0] + mean, np.sqrt(square - mean**2)


@pytest.mark.parametrize("model", MODELS_OF_EACH_KIND)
def test_the_smoother_finds_what_all_readings_at_once_tell(model):
    _, bins = filtered(eventful(seconds=24.0), corrected=False)
    states, after, before, _ = HeadingBank(SETTINGS, (model,)).kept(bins)
    turn, variance = _backward(bins, model, states[:, 0], after[:, 0], before[:, 0])
    each = twin.bins_from(bins, norm_of(bins))
    steps = twin.HeadingFilter(model, SETTINGS).run(each)
    first = next(k for k, step in enumerate(steps) if step is not None)
    expected, spread, bias = twin.smoothed(steps[first:])
    back, more = twin.carried_back(each, first, bias)
    assert (first > 5) == (model.after_s > 0.0)
    expected = np.concatenate([expected[0] + back, expected])
    spread = np.concatenate([spread[0] + more, spread])
    # The smoother's rounding, a microradian squared in every bin, is all the difference.
    assert np.abs(np.sin(turn - expected)).max() < 1e-6
    np.testing.assert_allclose(variance, spread, rtol=1e-4)
