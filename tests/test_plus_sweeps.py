"""A sweep written as a sequence of PLUS is the same sweep: every image mode pose is equal."""

from dataclasses import replace

import numpy as np
import pytest

from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.io.plus.write import write_sequence
from speckle3d.pipeline import track


@pytest.mark.slow
def test_the_shipped_sweep_tracks_alike_from_a_sequence(shipped, tmp_path):
    sweep = load_sweep(shipped / "phantom.h5").part(0, 20)
    write_sequence(tmp_path / "a.igs.mha", sweep)
    curves = read_curves(shipped / "curves.h5")
    got = track(load_sweep(tmp_path / "a.igs.mha"), curves)
    expected = track(replace(sweep, truth=None), curves)
    np.testing.assert_array_equal(got.image.as_matrix(), expected.image.as_matrix())
    # The sensor is interpolated at the frames' times in both, before and after it was written.
    np.testing.assert_allclose(got.subset.as_matrix(), expected.subset.as_matrix(), atol=1e-9)
