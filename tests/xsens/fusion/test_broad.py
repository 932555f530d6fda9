"""Orientation on BROAD trials beside VQF's own, on-line beside on-line and off-line beside off-line."""

from functools import cache

import numpy as np
import pytest
from broad import OFFLINE, ONLINE, coverage, errors_deg, estimate, read_trial, trials_in

GAIN = 0.8
"""Mean error over VQF's, the best there is: measured 0.73 on line, 0.71 off line, 0.74 without a constant."""

WORSE = 1.2
"""Error in any one trial over VQF's: none pays for the mean of the others. Measured 1.16 off line (trial 15,
where north by the field is 3 degrees off the cameras'), 1.00 on line."""

SHARES = (0.60, 0.95)
"""Of errors within one sigma. Sigma is about north, which iron turns in two trials of twelve: so in the
others more of heading's errors are within it than the 0.68 of a normal distribution."""

WIDEST = 2.0
"""RMS error over RMS sigma in the worst of a dozen trials: measured 1.57, of inclination in translation."""

EVERY = 4
"""Samples are scored at 71 Hz: the RMS is the same to 0.001 degrees."""

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
kinds = pytest.mark.parametrize("methods", [ONLINE, OFFLINE], ids=["on-line", "off-line"])


@pytest.fixture(scope="session")
def folder(realdata):
    return realdata / "broad"


@cache
def scores(folder, name):
    """By method: total error as BROAD counts it and without a constant heading, degrees; coverage of both."""
    log, true, moving = read_trial(folder, name)
    counts = moving & (np.arange(len(log)) % EVERY == 0)
    estimates = {method: estimate(log, method) for method in ONLINE + OFFLINE}
    return {
        method: [
            (errors_deg(result.wxyz, true, counts, steady)[0], coverage(result, true, counts, steady))
            for steady in (False, True)
        ]
        for method, result in estimates.items()
    }


def errors_of(folder, method):
    """Of every trial, both errors, shape (n, 2)."""
    return np.array([[error for error, _ in scores(folder, name)[method]] for name in trials_in(folder)])


def coverages(folder, name, method):
    """Coverage as BROAD counts and without a constant heading."""
    return [share for _, share in scores(folder, name)[method]]


def ratios(folder, name, methods):
    vqf_values, own_values = ([error for error, _ in scores(folder, name)[method]] for method in methods)
    return np.divide(own_values, vqf_values)


@kinds
def test_beside_a_magnet_the_error_is_less_than_vqfs(folder, methods):
    # Measured 0.47 on line, 0.60 off line.
    assert (ratios(folder, "28_disturbed_stationary_magnet_A", methods) <= 0.8).all()


@kinds
def test_mean_error_is_a_fifth_less_than_vqfs(folder, methods):
    vqf_values, own_values = (errors_of(folder, method).mean(axis=0) for method in methods)
    assert (own_values <= GAIN * vqf_values).all(), (own_values, vqf_values)


@kinds
def test_no_trial_is_much_worse_than_with_vqf(folder, methods):
    by_trial = {name: ratios(folder, name, methods) for name in trials_in(folder)}
    assert {name: ratio.round(2).tolist() for name, ratio in by_trial.items() if ratio.max() > WORSE} == {}


@kinds
@pytest.mark.parametrize("column", [0, 2], ids=["heading", "inclination"])
def test_claimed_sigma_fits_the_errors(folder, methods, column):
    # Heading as BROAD counts it: sigma is about north, and the cameras' is the field's at rest, to one degree
    # in most trials. Without a constant heading, errors are less and sigma is still that of north.
    names = trials_in(folder)
    as_broad, steady = zip(*(coverages(folder, name, methods[1]) for name in names), strict=True)
    share, least = (np.mean(coverage, axis=0)[column] for coverage in (as_broad, steady))
    assert SHARES[0] <= share <= SHARES[1]
    assert np.max([*as_broad, *steady], axis=0)[column + 1] <= WIDEST
    assert least >= SHARES[0]
