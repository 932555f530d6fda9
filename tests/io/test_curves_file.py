from dataclasses import replace

import h5py
import numpy as np
import pytest
import speckle

from speckle3d.core.curves import PROBE_SIGMA, NominalProbe, SpeckleSize, TiltResponse
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.curves import read_curves, write_curves

ARRAYS = ("depth_mm", "distance_mm", "correlation", "cells")


PARTS = {"tilt": ("pivot_mm", "spread_mm"), "speckle": ("lateral_mm", "axial_mm")}


def made(signal=speckle.RF, of="intensity", whole=False):
    tilt = TiltResponse(np.array([-7.5, 11.0]), np.array([1.5, 7.25])) if whole else None
    size = SpeckleSize(np.array([0.3, 0.4]), np.array([0.07, 0.08])) if whole else None
    probe = "L12-5, 4 cm, focus 2 cm" if whole else ""
    key = replace(speckle.KEY, signal=signal, correlation_of=of, edge_fraction=0.2, probe=probe)
    return replace(speckle.curves(sigma_mm=[0.3, 0.6]), key=key, pairs_used=4321, tilt=tilt, speckle=size)


@pytest.fixture
def path(tmp_path):
    write_curves(tmp_path / "curves.h5", made(whole=True))
    return tmp_path / "curves.h5"


@pytest.mark.parametrize("of", ["intensity", "echo"])
@pytest.mark.parametrize("whole", [False, True], ids=["curves alone", "tilt, speckle, probe"])
@pytest.mark.parametrize("signal", [speckle.RF, BModeSettings(60.0, 250.0)], ids=["rf", "bmode"])
def test_curves_come_back(tmp_path, signal, whole, of):
    written = made(signal, of, whole)
    write_curves(tmp_path / "c.h5", written)
    got = read_curves(tmp_path / "c.h5")
    assert got.key == written.key
    assert got.pairs_used == 4321
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(got, name), getattr(written, name))
    for part, names in PARTS.items():
        assert (getattr(got, part) is not None) == whole
        for name in names if whole else ():
            found, kept = (getattr(getattr(each, part), name) for each in (got, written))
            np.testing.assert_array_equal(found, kept)


def test_origin_and_error_come_back(tmp_path):
    nominal = NominalProbe(5.0, 20.0, 10.0, 5e6, 10e6, 0.5)
    write_curves(tmp_path / "c.h5", replace(made(), scale_sigma=0.03, origin="data sheet", nominal=nominal))
    got = read_curves(tmp_path / "c.h5")
    assert (got.scale_sigma, got.origin, got.nominal) == (0.03, "data sheet", nominal)


def test_an_unknown_origin_is_named(path):
    with h5py.File(path, "r+") as file:
        file.attrs["origin"] = "a dream"
    with pytest.raises(InvalidInputError, match=r"attribute origin: expected one of .*, got 'a dream'"):
        read_curves(path)


def test_files_of_earlier_versions_are_read(path):
    with h5py.File(path, "r+") as file:
        for name in ("correlation_of", "edge_fraction", "probe", "scale_sigma", "origin"):
            del file.attrs[name]
        del file["tilt"], file["speckle"]
    got = read_curves(path)
    assert (got.key.correlation_of, got.key.edge_fraction, got.key.probe) == ("intensity", 0.1, "")
    assert (got.scale_sigma, got.origin, got.nominal) == (PROBE_SIGMA, "phantom", None)
    assert got.tilt is None
    assert got.speckle is None


def test_an_older_file_stays_whole_when_writing_fails(path):
    before = path.read_bytes()
    broken = replace(speckle.curves(), key=replace(speckle.KEY, patch_width_mm=object()))
    with pytest.raises(TypeError):
        write_curves(path, broken)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
