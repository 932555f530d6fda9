import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import UNKNOWN_PAUSE_S, Stamps, timeline, timeline_of_times
from xsens.logs.samples import Gap, ImuLog

PERIOD_S = 1 / 256


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 65535), st.sets(st.integers(1, 900), max_size=60), st.sampled_from([1, 2, 4]))
def test_lost_samples_are_found_wherever_the_counter_wraps(first, lost, stride):
    taken = np.array([i for i in range(1000) if i not in lost])
    counter = (first + stride * taken) % 65536
    line = timeline(Stamps(counter=counter, period_s=PERIOD_S))
    np.testing.assert_allclose(line.time_s, taken * PERIOD_S, atol=1e-9)
    np.testing.assert_array_equal(line.counter, first + stride * taken)
    assert sum(gap.lost for gap in line.gaps) == len(lost)
    for gap in line.gaps:
        assert gap.lost == taken[gap.after_index + 1] - taken[gap.after_index] - 1
        assert gap.duration_s == pytest.approx((gap.lost + 1) * PERIOD_S)


def test_a_clock_tells_losses_longer_than_the_counter_can_count():
    taken = np.concatenate((np.arange(100), 70_000 + np.arange(100)))
    line = timeline(Stamps(counter=taken % 65536, ticks=(2**32 - 50 + 100 * taken) % 2**32))
    assert line.gaps == (Gap(99, 69_900, pytest.approx(699.01)),)
    np.testing.assert_array_equal(line.counter, taken)
    assert np.diff(line.time_s).max() == pytest.approx(699.01)


def test_a_clock_alone_tells_losses():
    taken = np.delete(np.arange(100), [10, 50, 51])
    line = timeline(Stamps(ticks=25 * taken))
    assert [(g.after_index, g.lost) for g in line.gaps] == [(9, 1), (48, 2)]
    assert line.counter is None


def test_repeated_samples_are_kept_once():
    line = timeline(Stamps(counter=np.array([5, 6, 6, 7]), period_s=0.01))
    assert line.rows.tolist() == [0, 1, 3]
    np.testing.assert_allclose(line.time_s, [0.0, 0.01, 0.02])
    assert [note.split()[0] for note in line.notes] == ["1"]


def test_a_new_start_without_a_clock_is_a_pause_that_interpolation_does_not_bridge():
    counter = np.concatenate((20_000 + np.arange(50), np.arange(50)))
    line = timeline(Stamps(counter=counter, period_s=0.01))
    assert line.gaps == (Gap(49, 0, UNKNOWN_PAUSE_S),)
    assert "taken as 1 s" in line.notes[0]


def test_a_new_start_is_as_long_as_the_computers_clock_says():
    counter = np.concatenate((50_000 + np.arange(50), np.arange(50), 7 + np.arange(50)))
    starts = np.isin(np.arange(150), [0, 50, 100])
    computer_s = np.where(starts, np.array([1000.0, 1010.0, 1020.5])[np.arange(150) // 50], np.nan)
    line = timeline(Stamps(counter=counter, period_s=0.01, starts=starts, computer_s=computer_s))
    np.testing.assert_allclose(line.time_s[[0, 50, 100]], [0.0, 10.0, 20.5])
    assert [(g.after_index, g.lost) for g in line.gaps] == [(49, 0), (99, 0)]
    assert (np.diff(line.time_s) > 0).all()


def test_a_computer_clock_that_went_back_is_not_believed():
    starts = np.isin(np.arange(100), [0, 50])
    computer_s = np.where(starts, np.array([1000.0, 900.0])[np.arange(100) // 50], np.nan)
    counter = np.arange(100) % 50
    line = timeline(Stamps(counter=counter, period_s=0.01, starts=starts, computer_s=computer_s))
    assert line.gaps == (Gap(49, 0, UNKNOWN_PAUSE_S),)


def test_a_time_needs_a_clock_or_a_counter_and_a_rate():
    with pytest.raises(InvalidInputError):
        timeline(Stamps())
    with pytest.raises(InvalidInputError, match="rate"):
        timeline(Stamps(counter=np.arange(3)))


def test_one_sample_has_a_time():
    assert timeline(Stamps(counter=np.array([3]), period_s=0.01)).time_s.tolist() == [0.0]
    assert timeline(Stamps(ticks=np.array([3]))).time_s.tolist() == pytest.approx([3e-4])


def test_times_out_of_order_are_sorted_and_pauses_found():
    line = timeline_of_times(np.array([0.0, 0.01, 0.03, 0.02, 0.03, 0.06, 0.07]))
    assert line.rows.tolist() == [0, 1, 3, 2, 5, 6]
    assert [(g.after_index, g.lost) for g in line.gaps] == [(3, 2)]
    assert [note.split()[0] for note in line.notes] == ["1", "1"]


def test_a_message_that_was_overtaken_is_put_in_its_place():
    counter = (65530 + np.array([0, 1, 2, 4, 3, 5, 7, 8, 6, 9])) % 65536
    line = timeline(Stamps(counter=counter, period_s=0.01))
    assert line.rows.tolist() == [0, 1, 2, 4, 3, 5, 8, 6, 7, 9]
    assert line.gaps == ()
    np.testing.assert_allclose(np.diff(line.time_s), 0.01)
    assert line.notes == ("2 samples came out of order and were sorted",)


def trembling(samples=2000, lost=()):
    """Times at 100 Hz that are off by up to 4 ms, some samples lost."""
    taken = np.setdiff1d(np.arange(samples), lost)
    return 0.01 * taken + np.random.default_rng(2).uniform(-0.004, 0.004, taken.size)


@pytest.mark.parametrize(
    "read", [timeline_of_times, lambda t: timeline(Stamps(ticks=np.round(1e4 * t + 50)))]
)
def test_a_clock_that_trembles_much_is_irregular_and_has_lost_nothing(read):
    times = trembling()
    assert (np.diff(times) > 0.016).sum() > 20  # or nothing is tried
    line = read(times)
    assert line.gaps == ()
    assert "irregular clock" in line.notes[0]
    log = ImuLog(line.time_s, gaps=line.gaps, accelerometer_m_s2=np.ones((2000, 3)))
    # As many samples as the rate and the duration make.
    assert (len(log) + log.lost - 1) / log.duration_s == pytest.approx(log.rate_hz, rel=1e-9)
    assert log.rate_hz == pytest.approx(100.0, rel=1e-3)


def test_a_pause_is_found_even_by_a_clock_that_trembles():
    line = timeline_of_times(trembling(lost=np.arange(700, 760)))
    assert [gap.after_index for gap in line.gaps] == [699]
    assert abs(line.gaps[0].lost - 60) <= 1


def test_the_rate_is_the_sensors_whatever_was_lost():
    # More than half of the samples lost: the step that is most common is of two periods.
    taken = np.cumsum(np.random.default_rng(5).choice([1, 2, 3], p=[0.3, 0.6, 0.1], size=500))
    line = timeline(
        Stamps(counter=taken, ticks=np.round(1e6 * taken / 60), tick_s=1e-6, counter_span=1 << 32)
    )
    log = ImuLog(line.time_s, gaps=line.gaps, counter=line.counter)
    assert log.rate_hz == pytest.approx(60.0, rel=1e-4)
    assert len(log) + log.lost == taken[-1] - taken[0] + 1
