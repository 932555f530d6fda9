from dataclasses import replace

import h5py
import numpy as np
import pytest
import speckle

from speckle3d.core.curves import TiltResponse
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.curves import read_curves, write_curves

ARRAYS = ("depth_mm", "distance_mm", "correlation", "cells")


TILT = ("pivot_mm", "spread_mm")


def made(signal=speckle.RF, of="intensity", turned=False):
    tilt = TiltResponse(np.array([-7.5, 11.0]), np.array([1.5, 7.25])) if turned else None
    key = replace(speckle.KEY, signal=signal, correlation_of=of)
    return replace(speckle.curves(sigma_mm=[0.3, 0.6]), key=key, pairs_used=4321, tilt=tilt)


@pytest.fixture
def path(tmp_path):
    write_curves(tmp_path / "curves.h5", made(turned=True))
    return tmp_path / "curves.h5"


@pytest.mark.parametrize("of", ["intensity", "echo"])
@pytest.mark.parametrize("turned", [False, True], ids=["no tilt", "tilt"])
@pytest.mark.parametrize("signal", [speckle.RF, BModeSettings(60.0, 250.0)], ids=["rf", "bmode"])
def test_curves_come_back(tmp_path, signal, turned, of):
    written = made(signal, of, turned)
    write_curves(tmp_path / "c.h5", written)
    got = read_curves(tmp_path / "c.h5")
    assert got.key == written.key
    assert got.pairs_used == 4321
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(got, name), getattr(written, name))
    assert (got.tilt is not None) == turned
    for name in TILT if turned else ():
        np.testing.assert_array_equal(getattr(got.tilt, name), getattr(written.tilt, name))


def test_files_from_before_echoes_were_correlated_hold_intensity(path):
    with h5py.File(path, "r+") as file:
        del file.attrs["correlation_of"], file["tilt"]
    got = read_curves(path)
    assert got.key.correlation_of == "intensity"
    assert got.tilt is None


def test_an_older_file_stays_whole_when_writing_fails(path):
    before = path.read_bytes()
    broken = replace(speckle.curves(), key=replace(speckle.KEY, patch_width_mm=object()))
    with pytest.raises(TypeError):
        write_curves(path, broken)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
