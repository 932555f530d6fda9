"""The heading's kernels against the same filter with full matrices, and cases whose answer is known."""

import heading_twin as twin
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from speckle3d.kernels.orientation import heading_arrays as at
from xsens.fusion.bins import averaged_bins, filtered_bins, steps_per_bin
from xsens.fusion.heading import (
    FIRST_STRAY,
    MEMORY_S,
    MODELS,
    FieldModel,
    HeadingBank,
    _backward,
    smooth_headings,
    weights_of,
)
from xsens.fusion.inclination import forward, fresh_filter
from xsens.fusion.samples import Samples
from xsens.fusion.settings import FusionSettings
from xsens.fusion.stretch import smoothed

RATE_HZ = 50.0
EARTH = np.array([18.0, 0.0, -45.0])
SETTINGS = FusionSettings()
MODELS_OF_EACH_KIND = (
    FieldModel(0.02),
    FieldModel(0.05, stray_s=8.0, handicap=3.0),
    FieldModel(0.03, after_s=5.0, handicap=2.0),
    FieldModel(0.02, iron=0.02, iron_put_on=0.15, handicap=5.0, online_handicap=-2.0),
    FieldModel(0.03, iron=0.7, iron_put_on=0.15, handicap=5.0),
)


def attitude(time_s):
    """A sensor that is turned about all axes."""
    angles = np.column_stack([np.sin(1.3 * time_s), 0.9 * np.sin(0.7 * time_s), np.sin(1.1 * time_s)])
    return Rotation.from_euler("ZYX", 1.2 * angles)


def turned(seconds, seed, rests=True):
    """Samples without a field of a sensor that is turned; its truth; and the source of chance."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    moving = (np.sin(0.5 * time_s) > -0.6) | (not rests)
    truth = attitude(np.cumsum(moving) / RATE_HZ)
    rate = (truth[:-1].inv() * truth[1:]).as_rotvec() * RATE_HZ
    rate = np.array([0.004, -0.003, 0.005]) + np.vstack([rate[:1], rate])
    rate += 0.003 * rng.standard_normal(rate.shape)
    force = truth.inv().apply([0.0, 0.0, 9.80665]) + 0.03 * rng.standard_normal(rate.shape)
    force += 0.2 * moving[:, None] * rng.standard_normal(rate.shape)
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
    if corrected:
        return steps, filtered_bins(steps, SETTINGS)[0]
    sds = (steps.bias_sd_rad_s, steps.sd_rad)
    return steps, averaged_bins(steps, steps.start, steps.bias_rad_s, *sds, SETTINGS)


def at_ends(steps, bins):
    """The bias at the end of each bin."""
    ends = np.arange(1, len(bins) + 1) * steps_per_bin(SETTINGS)
    return steps.bias_rad_s[np.minimum(ends, len(steps.bias_rad_s)) - 1]


def norm_of(bins, most=None):
    seen = bins[bins[:, at.SEEN] > 0.0][:most]
    return np.median(np.linalg.norm(seen[:, at.READING : at.READING + 3], axis=1))


def filled(steps, name, missing):
    """A column of the plain filters' steps, shape (bins, models)."""
    return np.array(
        [[missing if one is None else getattr(one, name) for one in row] for row in zip(*steps, strict=True)]
    )


def test_every_models_filter_takes_the_plain_filters_steps():
    _, bins = filtered(eventful())
    states, after, before, found = HeadingBank(SETTINGS, MODELS_OF_EACH_KIND, 0.4).kept(bins)
    each = twin.bins_from(bins, norm_of(bins))
    plain = [twin.HeadingFilter(model, SETTINGS, 0.4).run(each) for model in MODELS_OF_EACH_KIND]
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


def test_a_late_model_has_the_evidence_of_the_best_one_until_it_begins():
    _, bins = filtered(eventful())
    each = twin.bins_from(bins, norm_of(bins))
    plain = [twin.HeadingFilter(model, SETTINGS).run(each) for model in MODELS_OF_EACH_KIND]
    table = filled(plain, "evidence", np.nan)
    total = np.nansum(table, axis=0)
    (late,) = (k for k, model in enumerate(MODELS_OF_EACH_KIND) if model.after_s)
    begins = np.flatnonzero(np.isfinite(table[:, late]))[0]
    total[late] += max(np.nansum(table[:begins, k]) for k in range(len(plain)) if k != late)
    total -= [model.handicap for model in MODELS_OF_EACH_KIND]
    np.testing.assert_allclose(
        HeadingBank(SETTINGS, MODELS_OF_EACH_KIND, 1.0).evidence(bins), total, rtol=1e-9
    )


def test_the_bank_follows_as_the_plain_filters_do_through_a_pause_and_corrections():
    samples, level = eventful(), fresh_filter(SETTINGS)
    bank = HeadingBank(SETTINGS, MODELS_OF_EACH_KIND)
    plain = [twin.HeadingFilter(model, SETTINGS, FIRST_STRAY) for model in MODELS_OF_EACH_KIND]
    handicaps = [0.0, 3.0, 2.0, -2.0, 5.0]  # while samples arrive
    norm, scores = None, np.full(len(plain), np.nan)
    for part, pause_s in ((samples[:1100], 0.0), (samples[1100:], 2.0)):
        if pause_s:
            bank.resume()
            for one in plain:
                one.resume()
        steps, bins = filtered(part, level, pause_s)
        norm = norm or norm_of(bins, 1)
        biases = at_ends(steps, bins)
        found = bank.follow(bins, biases)
        each = twin.bins_from(bins, norm, np.diff(biases, axis=0, prepend=biases[:1]))
        rows = [one.run(each) for one in plain]
        weights = []
        for one, evidence in zip(each, filled(rows, "evidence", np.nan), strict=True):
            scores = remembered(scores, evidence, one.span_s)
            weights.append(shares(scores - handicaps))
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
    states, after, before, _ = HeadingBank(SETTINGS, (model,), 1.0).kept(bins)
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


def test_a_recordings_heading_is_the_mean_over_the_models_by_their_evidence():
    samples, truth, rng = turned(8.0, 4)  # too short to tell the models apart
    field = EARTH + 0.05 * np.cumsum(rng.standard_normal((len(samples), 3)), axis=0)
    _, bins = filtered(with_field(samples, truth.inv().apply(field)), corrected=False)
    found = smooth_headings(bins, SETTINGS)
    evidence = HeadingBank(SETTINGS, first_stray=1.0).evidence(bins)
    likely = np.flatnonzero(evidence > evidence.max() - 8.0)
    assert len(likely) > 1
    states, after, before, _ = HeadingBank(SETTINGS, [MODELS[k] for k in likely], 1.0).kept(bins)
    each = [_backward(bins, MODELS[k], states[:, i], after[:, i], before[:, i]) for i, k in enumerate(likely)]
    turns, variances = np.moveaxis(each, 0, -1)
    weights = np.tile(softmax(evidence[likely]), (len(bins), 1))
    turn, sd = mixture(turns, variances, weights)
    # Models below one in a hundred are left out.
    assert (np.abs(found.turn_rad - turn) < 0.1 * sd).all()
    np.testing.assert_allclose(found.sd_rad, sd, rtol=0.02)


def test_a_bins_correction_is_that_of_its_steps_one_after_another():
    steps, bins = filtered(eventful(seconds=8.0))
    per_bin = steps_per_bin(SETTINGS)
    for k, row in enumerate(bins):
        turn = np.eye(3)
        for i in range(per_bin * k, min(per_bin * (k + 1), len(steps.last))):
            turn = steps.corrected[i] @ np.linalg.inv(steps.predicted[i]) @ turn
        np.testing.assert_allclose(row[at.CORRECTION : at.CORRECTION + 9], turn.ravel(), atol=1e-12)


# -- known answers


def heading_deg(orientations, truth):
    return np.rad2deg(np.abs((orientations * truth.inv()).as_rotvec()[:, 2]))


def test_iron_on_the_sensor_from_the_start_is_found_by_turning_it():
    samples, truth, rng = turned(60.0, 8, rests=False)
    iron = np.array([12.0, -9.0, 5.0])  # a third of the field's norm, more than its horizontal part's half
    samples = with_field(
        samples, truth.inv().apply(EARTH) + iron + 0.3 * rng.standard_normal((len(truth), 3))
    )
    model = max(MODELS, key=lambda one: (one.iron, -one.stray))
    steps, bins = filtered(samples)
    bank = HeadingBank(SETTINGS, (model,))
    states, _, _, found = bank.kept(bins)
    np.testing.assert_allclose(states[-1, 0, 6:9] * norm_of(bins), iron, atol=0.3)
    ends = np.minimum(np.arange(1, len(bins) + 1) * steps_per_bin(SETTINGS), len(steps.last)) - 1
    turns = Rotation.from_euler("z", found[:, :1, at.FOUND_TURN]) * Rotation.from_matrix(
        steps.corrected[ends]
    )
    assert heading_deg(turns, truth[steps.last[ends] - 1])[-20:].max() < 1.0
    estimate = smoothed(samples, SETTINGS)
    assert heading_deg(Rotation.from_quat(estimate.xyzw), truth).max() < 1.0


@pytest.mark.parametrize("lag_s", [0.0, 0.012])
def test_the_magnetometers_lag_is_found(lag_s):
    samples, truth, rng = turned(60.0, 9, rests=False)
    read_s = np.arange(1, len(truth) + 1) / RATE_HZ - lag_s
    field = attitude(read_s).inv().apply(EARTH) + 0.3 * rng.standard_normal((len(truth), 3))
    _, bins = filtered(with_field(samples, field))
    states, _, _, _ = HeadingBank(SETTINGS, MODELS[:1]).kept(bins)
    assert abs(states[-1, 0, 15] - lag_s) < 0.001


SPAN_S, MANY = 0.25, 400


def still_bins():
    """Bins of a field that does not change, in a sensor that is carried about without being turned."""
    bins = np.zeros((MANY, at.BIN))
    bins[:, at.SPAN], bins[:, at.SEEN], bins[:, at.BIAS_VARIANCE] = SPAN_S, 1.0, 1e-16
    bins[:, at.READING : at.READING + 3] = EARTH
    for place in (at.POSE, at.CORRECTION):
        bins[:, place : place + 9] = np.eye(3).ravel()
    return bins


def least_variance(model, span_s, count):
    """Least variance of a heading from a stray of first order, rad^2.

    Of the first reading's stray, (1 - keep^2) / (1 - keep)^2 times as much variance is in the news of each
    later one: the weights of the best mean of equidistant readings of an Ornstein-Uhlenbeck process.
    """
    keep = np.exp(-span_s / model.stray_s)
    first = 1.0 - keep**2 * (1.0 - FIRST_STRAY**2)
    shares = 1.0 / first + (count - 1) * (1.0 - keep) / (1.0 + keep)
    return model.stray**2 / shares / (EARTH[0] / np.linalg.norm(EARTH)) ** 2


@pytest.mark.parametrize("stray_s", [2.0, 8.0])
def test_heading_is_as_certain_as_the_number_of_independent_readings_allows(stray_s):
    model = FieldModel(0.08, stray_s=stray_s, iron=1e-9)
    sure = FusionSettings(field_first_place=1e-9, field_noise_sqrt_s=1e-6)
    _, sd = follow(still_bins(), model, sure)
    least = np.sqrt(least_variance(model, SPAN_S, np.arange(1, MANY + 1)))
    assert (sd > 0.999 * least).all()
    assert sd[-1] < 1.05 * least[-1]  # the room's walk is all that is left to not know
    samples, truth, rng = turned(60.0, 10)
    stray = np.cumsum(rng.standard_normal((len(samples), 3)), axis=0) * 0.02
    _, bins = filtered(with_field(samples, truth.inv().apply(EARTH + stray)))
    _, sd = follow(bins, model, SETTINGS)
    assert sd[-1] > np.sqrt(least_variance(model, bins[0, at.SPAN], len(bins)))


def follow(bins, model, settings):
    found = HeadingBank(settings, (model,)).follow(bins, np.zeros((len(bins), 3)))
    return found.turn_rad, found.sd_rad


@pytest.mark.parametrize("angle_rad", [0.4, 3.0])
def test_turning_all_readings_about_up_turns_the_heading_alone(angle_rad):
    _, bins = filtered(eventful())
    about_up = Rotation.from_euler("z", angle_rad).as_matrix()
    rows = bins.copy()
    for place in (at.READING, at.LATE):
        rows[:, place : place + 3] = bins[:, place : place + 3] @ about_up.T
    poses, corrections = (
        about_up @ bins[:, place : place + 9].reshape(-1, 3, 3) for place in (at.POSE, at.CORRECTION)
    )
    rows[:, at.POSE : at.POSE + 9] = poses.reshape(-1, 9)
    rows[:, at.CORRECTION : at.CORRECTION + 9] = (corrections @ about_up.T).reshape(-1, 9)
    (one, other), (sd, other_sd) = zip(*(both(each) for each in (bins, rows)), strict=True)
    known = sd < np.pi
    assert np.abs(np.exp(1j * (other + angle_rad - one)) - 1.0)[known].max() < 1e-7
    assert known.mean() > 0.9
    np.testing.assert_allclose(other_sd, sd, rtol=1e-6)


def test_the_fields_unit_does_not_matter():
    _, bins = filtered(eventful())
    tesla = bins.copy()
    for place in (at.READING, at.LATE):
        tesla[:, place : place + 3] *= 1e-6
    np.testing.assert_allclose(both(tesla), both(bins), rtol=1e-7, atol=1e-9)


def both(bins):
    """Turns and deviations while readings arrive, and smoothed."""
    following = HeadingBank(SETTINGS).follow(bins, np.zeros((len(bins), 3)))
    whole = smooth_headings(bins, SETTINGS)
    return np.hstack([following.turn_rad, whole.turn_rad]), np.hstack([following.sd_rad, whole.sd_rad])


def test_weights_sum_to_one_and_a_model_that_has_not_begun_has_none():
    evidence = np.array([-40_000.0, np.nan, -40_003.0, 12_000.0, 11_999.0, np.nan])
    weights = weights_of(evidence)
    np.testing.assert_allclose(weights, [0.0, 0.0, 0.0, *softmax([1.0, 0.0]), 0.0], atol=1e-12)
    assert weights_of(np.full(4, np.nan)).sum() == 1.0


def test_a_model_that_begins_late_has_no_say_before():
    _, bins = filtered(eventful())
    early, late = FieldModel(0.02), FieldModel(0.01, after_s=8.0, handicap=-1e6)
    biases = np.zeros((len(bins), 3))
    alone, other, mixed = (
        HeadingBank(SETTINGS, models).follow(bins, biases) for models in ((early,), (late,), (early, late))
    )
    begins = np.flatnonzero(other.sd_rad < np.pi)[0]
    assert begins > 20
    np.testing.assert_array_equal(mixed.turn_rad[:begins], alone.turn_rad[:begins])
    np.testing.assert_array_equal(mixed.sd_rad[:begins], alone.sd_rad[:begins])
    np.testing.assert_allclose(mixed.turn_rad[begins:], other.turn_rad[begins:], atol=1e-12)
