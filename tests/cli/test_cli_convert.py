"""`convert`: out by suffix, options of every setting, and all real recordings of PLUS at the first try."""

import json
import re

import numpy as np
import pytest
from image_examples import grey, tracked, write_mha

from speckle3d.io.load import load_sweep

PIXELS = ("--column-pitch-mm", "0.1", "--row-spacing-mm", "0.2", "--dynamic-range-db", "60")


@pytest.fixture
def sequence(tmp_path):
    return write_mha(tmp_path / "a.igs.mha", grey(), frames=tracked(3)[2])


@pytest.fixture
def done(run):
    """Run a command, which must succeed; returns stdout and stderr."""

    def call(*arguments):
        code, out, err = run(*arguments)
        assert code == 0, err
        return out, err

    return call


def test_the_suffix_of_out_says_what_is_written(done, sequence, tmp_path):
    h5, back, nrrd = (tmp_path / name for name in ("a.h5", "b.igs.mha", "c.igs.nrrd"))
    done("convert", sequence, h5, *PIXELS)
    for source, out in ((h5, back), (back, nrrd), (nrrd, h5), (nrrd, back)):
        assert done("convert", source, out)[0] == ""
        sweep = load_sweep(out)
        np.testing.assert_array_equal(sweep.frames[2], grey()[2].T)
        assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == (0.1, 0.2)
        assert len(sweep.tracker.readings) == 3


CONFIG = "PlusDeviceSet_"
SPINE = f"{CONFIG}SpinePhantomFreehandReconstructionOnly.xml"
LINEAR = f"{CONFIG}RfProcessingAlgoLinearTest.xml"
ECHOES = {"centre_frequency_hz": "6e6", "bandwidth_hz": "4e6 8e6"}

SWEEPS = {
    "plus/SpinePhantomFreehand.igs.mha": (SPINE, {}, (21, 820, 616), 21),
    "plus/UltrasonixLinearRfData.igs.mha": (
        LINEAR,
        ECHOES | {"sampling_rate_hz": "40e6", "demodulation_frequency_hz": "0"},
        (1, 128, 2080),
        None,
    ),
    "rf/MouseLiverRF.mha": (None, ECHOES | {"frame_rate_hz": "30"}, (4, 128, 1536), None),
}
"""By file: the device set beside it, what neither says, the frames, and the poses of its tracker."""


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("name", SWEEPS)
def test_real_recordings_convert_at_the_first_try_and_back(realdata, run, done, tmp_path, name):
    config, asked, shape, poses = SWEEPS[name]
    source, h5, back = realdata / name, tmp_path / "a.h5", tmp_path / "back.mha"
    given = [] if config is None else ["--plus-config", source.parent / config]
    code, _, err = run("convert", source, h5, *given)
    assert code == (2 if asked else 0)
    assert len(err.splitlines()) == 1 or not asked
    # All that is missing, and nothing else, at once.
    assert {*re.findall(r"--([\w-]+) \(", err)} == {each.replace("_", "-") for each in asked}
    options = [
        word for name, value in asked.items() for word in (f"--{name.replace('_', '-')}", *value.split())
    ]
    done("convert", source, h5, *given, *options)
    rows = {row["description"]: row["value"] for row in json.loads(done("info", source, "--json")[0])}
    assert "none: " in rows["sweep"]
    assert rows["size"].split(" x ")[0] in map(str, (shape[1], shape[2]))
    sweep = load_sweep(h5)
    assert sweep.frames.shape == shape
    assert (None if sweep.tracker is None else len(sweep.tracker.readings)) == poses
    if poses and config is not None:
        assert sweep.tracker.sensor_from_image is not None
    done("convert", h5, back)
    again = load_sweep(back)
    middle = shape[0] // 2
    np.testing.assert_array_equal(again.frames[middle], sweep.frames[middle])
    assert (again.grid, again.signal) == (sweep.grid, sweep.signal)
