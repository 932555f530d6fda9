"""`convert`: out by suffix."""

import numpy as np
from image_examples import grey, tracked, write_mha

from speckle3d.io.load import load_sweep

PIXELS = ("--column-pitch-mm", "0.1", "--row-spacing-mm", "0.2", "--dynamic-range-db", "60")


def test_the_suffix_of_out_says_what_is_written(run, tmp_path):
    sequence = write_mha(tmp_path / "a.igs.mha", grey(), frames=tracked(3)[2])
    h5, back, nrrd = (tmp_path / name for name in ("a.h5", "b.igs.mha", "c.igs.nrrd"))
    assert run("convert", sequence, h5, *PIXELS)[0] == 0
    for source, out in ((h5, back), (back, nrrd), (nrrd, h5), (nrrd, back)):
        assert run("convert", source, out)[:2] == (0, "")
        sweep = load_sweep(out)
        np.testing.assert_array_equal(sweep.frames[2], grey()[2].T)
        assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)
        assert len(sweep.tracker.readings) == 3
