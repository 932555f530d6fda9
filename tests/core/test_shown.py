"""Results show themselves in a few lines, and are handed over to other libraries."""

import numpy as np
import pytest


def test_a_repr_has_a_few_lines(tracking, sweep, curves):
    for thing in (tracking, sweep, sweep.tracker, sweep.orientation, curves):
        assert 2 <= len(repr(thing).splitlines()) <= 14


def test_a_table_has_a_row_for_each_frame(tracking, sweep):
    pytest.importorskip("pandas")
    table = tracking.to_dataframe()
    assert len(table) == len(sweep)
    truth = np.abs(np.diff(sweep.truth.apply(sweep.grid.centre_mm), axis=0)).sum()
    assert table["length_mm"].iloc[-1] < truth
    assert (table["sigma_z_mm"].iloc[1:] > 0).all()
    np.testing.assert_allclose(table["time_s"], sweep.frame_time_s)


def test_frames_become_a_labelled_array(sweep):
    pytest.importorskip("xarray")
    array = sweep.part(0, 3).to_xarray()
    assert array.dims == ("frame", "lateral_mm", "depth_mm")
    np.testing.assert_array_equal(array.sel(frame=2), sweep.frames[2])
    assert float(array.depth_mm[-1]) == pytest.approx(sweep.grid.depth_mm)
