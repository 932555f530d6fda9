from dataclasses import replace

import h5py
import numpy as np
import pytest
import speckle
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from speckle3d.core.curves import TiltResponse
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
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


def test_nothing_is_left_where_writing_fails(tmp_path):
    with pytest.raises(FileError, match="nowhere"):
        write_curves(tmp_path / "nowhere" / "c.h5", speckle.curves())
    assert list(tmp_path.iterdir()) == []


def test_an_older_file_stays_whole_when_writing_fails(path):
    before = path.read_bytes()
    broken = replace(speckle.curves(), key=replace(speckle.KEY, patch_width_mm=object()))
    with pytest.raises(TypeError):
        write_curves(path, broken)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("name", [*ARRAYS, *(f"tilt/{name}" for name in TILT)])
def test_a_missing_data_set_is_named(path, name):
    with h5py.File(path, "r+") as file:
        del file[name]
    with pytest.raises(InvalidInputError, match=rf"curves\.h5: /{name}"):
        read_curves(path)


@pytest.mark.parametrize(
    "name",
    ["vector_pitch_mm", "patch_width_mm", "patch_height_mm", "equalise_mm", "signal", "sampling_rate_hz",
     "speed_of_sound_m_s", "centre_frequency_hz", "bandwidth_hz", "format", "version"],
)  # fmt: skip
def test_a_missing_attribute_is_named(path, name):
    with h5py.File(path, "r+") as file:
        del file.attrs[name]
    with pytest.raises(InvalidInputError, match=name) as error:
        read_curves(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("correlation", lambda a: a[:, :-1], r"/correlation.*\(2, 201\).*\(2, 200\)"),
        ("correlation", lambda a: 1.5 * a, "correlation"),
        ("correlation", lambda a: a[:, ::-1], "one that rises"),
        ("depth_mm", lambda a: a[::-1], "/depth_mm"),
        ("depth_mm", lambda a: a * np.nan, r"/depth_mm\[0\]"),
        ("distance_mm", lambda a: a + 1, "distance_mm"),
        ("cells", lambda a: -a, "cells"),
        ("cells", lambda a: a[:1], r"/cells.*\(2,\).*\(1,\)"),
        ("cells", lambda a: a.astype("S8"), "/cells"),
        ("tilt/pivot_mm", lambda a: a[:1], r"/tilt/pivot_mm.*\(2,\).*\(1,\)"),
        ("tilt/pivot_mm", lambda a: a * np.nan, "pivot_mm"),
        ("tilt/spread_mm", lambda a: a + np.inf, "spread_mm"),
        ("tilt/spread_mm", lambda a: a.astype("S8"), "/tilt/spread_mm"),
    ],
)
def test_what_is_wrong_is_said_with_the_file(path, name, change, message):
    with h5py.File(path, "r+") as file:
        spoiled = change(file[name][()])
        del file[name]
        file[name] = spoiled
    with pytest.raises(InvalidInputError, match=message) as error:
        read_curves(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("signal", "video", "'rf'.*'bmode'.*'video'"),
        ("correlation_of", "amplitude", "correlation_of.*'ampl"),
        ("correlation_of", 3.0, "correlation_of"),
        ("format", "speckle3d.sweep", r"'speckle3d\.curves'.*'speckle3d\.sweep'"),
        ("version", 2, "version 1, got 2"),
        ("sampling_rate_hz", np.nan, "sampling_rate_hz"),
        ("bandwidth_hz", (9e6, 4e6), "bandwidth_hz"),
    ],
)
def test_an_attribute_that_is_wrong_is_named(path, name, value, message):
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(InvalidInputError, match=message):
        read_curves(path)


def test_files_that_are_not_curves(tmp_path):
    with pytest.raises(FileError, match="expected a file, got none"):
        read_curves(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("curves")
    with pytest.raises(FileError, match="expected an HDF5 file"):
        read_curves(tmp_path / "text.h5")


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_an_error_of_one_line_or_harmless(path, tmp_path, data):
    whole = path.read_bytes()
    damaged = bytearray(whole[: data.draw(st.sampled_from([len(whole), len(whole) // 2, 600]))])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "damaged.h5").write_bytes(damaged)
    try:
        read_curves(tmp_path / "damaged.h5")
    except Speckle3DError as error:
        message = str(error)
        assert "\n" not in message
