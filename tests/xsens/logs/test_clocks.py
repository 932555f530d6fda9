import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xsens.logs.clocks import COUNTS, Stamps, timeline, unwrap
from xsens.logs.samples import ImuLog

PERIOD_S = 1 / 256


@settings(max_examples=60)
@given(st.integers(0, 65535), st.sets(st.integers(1, 900), max_size=60), st.sampled_from([1, 2, 4]))
def test_lost_samples_are_found_wherever_the_counter_wraps(first, missing, stride):
    indices = np.array([i for i in range(1000) if i not in missing])
    counter = (first + stride * indices) % 65536
    line = timeline(Stamps(unwrap(counter, COUNTS), period_s=PERIOD_S))
    np.testing.assert_allclose(line.time_s, indices * PERIOD_S, atol=1e-9)
    np.testing.assert_array_equal(line.counter, first + stride * indices)
    assert sum(gap.lost for gap in line.gaps) == len(missing)
    for gap in line.gaps:
        assert gap.lost == indices[gap.after_index + 1] - indices[gap.after_index] - 1
        assert gap.duration_s == pytest.approx((gap.lost + 1) * PERIOD_S)


def test_a_counter_that_never_falls_has_not_wrapped_round():
    line = timeline(Stamps(unwrap(np.array([0, 1, 2, 40002, 40003]), COUNTS), period_s=0.01))
    assert [gap.lost for gap in line.gaps] == [39999]


@pytest.mark.parametrize(
    "at", [[0, 1, 2, 4, 3], [*range(300), *range(301, 1500), 300], [*range(800), *range(600, 700)]]
)
def test_samples_that_come_too_late_are_sorted_and_no_new_start(at):
    counter = (65000 + np.array([*at, *range(max(at) + 1, 2000)])) % 65536
    line = timeline(Stamps(unwrap(counter, COUNTS), period_s=0.01))
    np.testing.assert_allclose(line.time_s, 0.01 * np.arange(2000), atol=1e-9)
    assert "out of order" in line.notes[0]
    assert line.gaps == ()


def test_times_that_jump_back_show_a_new_start():
    once = 0.01 * np.arange(300)
    line = timeline(Stamps(time_s=np.concatenate([once, once])))
    assert line.time_s.size == 600
    assert [gap.after_index for gap in line.gaps] == [299]
    assert (np.diff(line.time_s) > 0).all()


def trembling(samples=2000, missing=()):
    """Times at 100 Hz that are off by up to 4 ms, some samples lost."""
    indices = np.setdiff1d(np.arange(samples), missing)
    return 0.01 * indices + np.random.default_rng(2).uniform(-0.004, 0.004, indices.size)


def test_a_clock_that_trembles_much_is_irregular_and_has_lost_nothing():
    times = trembling()
    assert (np.diff(times) > 0.016).sum() > 20  # or nothing is tried
    line = timeline(Stamps(time_s=times))
    assert line.gaps == ()
    assert "irregular clock" in line.notes[0]
    log = ImuLog(line.time_s, gaps=line.gaps, accelerometer_m_s2=np.ones((2000, 3)))
    # As many samples as the rate and the duration make.
    assert (len(log) + log.lost - 1) / log.duration_s == pytest.approx(log.rate_hz, rel=1e-9)
    assert log.rate_hz == pytest.approx(100.0, rel=1e-3)


def test_samples_that_came_together_are_spread_over_the_time_since_those_before():
    taken_s = 0.01 * np.arange(400)
    deliveries = Stamps(time_s=np.ceil(np.arange(1, 401) / 5) * 0.05)
    line = timeline(deliveries, [np.random.default_rng(3).standard_normal((400, 3))])
    np.testing.assert_allclose(line.time_s, taken_s + 0.01, atol=1e-9)
    sent_again = [np.repeat(np.arange(80.0), 5)[:, None]]
    assert timeline(deliveries, sent_again).time_s.size == 80
