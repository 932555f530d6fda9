"""Results show themselves in ten lines, and are handed over to other libraries."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.volume import Volume


def test_a_repr_has_a_few_lines(tracking, sweep, curves):
    for thing in (tracking, sweep, sweep.tracker, sweep.orientation, curves):
        assert 2 <= len(repr(thing).splitlines()) <= 10


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


def test_a_volume_lies_in_napari_where_it_lies_in_the_world():
    placement = RigidTransform.from_components([1.0, 2.0, 3.0], RigidTransform.identity().rotation)
    volume = Volume(np.arange(24, dtype=np.uint8).reshape(4, 3, 2), (0.5, 0.5, 1.0), placement)
    voxels, fields, kind = volume.to_napari()
    assert kind == "image"
    assert voxels is volume.voxels
    np.testing.assert_allclose(fields["affine"] @ [2, 1, 1, 1], [2.0, 2.5, 4.0, 1.0])
