import numpy as np
import pytest
from sweep_examples import rf_sweep


def test_a_part_has_its_own_frames_times_and_truth_and_all_readings():
    whole = rf_sweep(frames=6)
    part = whole.part(2, 5)
    for number in range(3):
        np.testing.assert_array_equal(part.frames[number], whole.frames[2 + number])
    np.testing.assert_array_equal(part.frame_time_s, whole.frame_time_s[2:5])
    np.testing.assert_array_equal(part.truth.as_matrix(), whole.truth[2:5].as_matrix())
    assert part.tracker is whole.tracker
    with pytest.raises(IndexError):
        part.frames[3]
