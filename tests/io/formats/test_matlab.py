import h5py
import numpy as np
import pytest
from format_examples import FRAMES, SAMPLES, VECTORS, grey, iq, matlab_order, rf, write_mat
from sweep_examples import frames_of, sizes_of

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep

TIMES = 0.1 * np.arange(FRAMES)
AXES = "sample, vector, frame"
VERSIONS = pytest.mark.parametrize("new", [False, True], ids=["version 5", "version 7.3"])


def save(tmp_path, new=False, **changes):
    variables = {
        "RData": matlab_order(rf()),
        "Cells": [matlab_order(rf(5)), np.arange(3.0)],
        "Trans": {"spacingMm": 0.3, "frequency": 6.25, "kind": "linear"},
        "band": np.array([4.0, 8.0]),
        "t": TIMES,
    }
    return write_mat(tmp_path / "a.mat", new, **variables | changes)


def settings_of(**arrays):
    names = {"axes": AXES, "vector_pitch_mm": "Trans.spacingMm", "time_s": "t"} | arrays
    names |= {"centre_frequency_hz": "Trans.frequency / 1e-6", "bandwidth_hz": "band * 1e6"}
    return ImportSettings(sampling_rate_hz=40e6, arrays={k: v for k, v in names.items() if v is not None})


@VERSIONS
@pytest.mark.parametrize(("array", "frames"), [("RData", rf()), ("Cells{1}", rf(5))])
def test_rf_by_its_mapping(tmp_path, new, array, frames):
    sweep = load_sweep(save(tmp_path, new), settings_of(rf=array))
    np.testing.assert_array_equal(frames_of(sweep), frames)
    assert sweep.frames.dtype == np.int16
    assert sweep.signal == RFSettings(40e6, 1540.0, 6.25e6, (4e6, 8e6))
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.3, 1540.0 / 80e3, 0.0)
    np.testing.assert_array_equal(sweep.frame_time_s, TIMES)


@VERSIONS
@pytest.mark.parametrize("axes", ["vector, frame, sample", "frame, sample, -, vector"])
def test_axes_in_any_order(tmp_path, new, axes):
    names = [name.strip() for name in axes.split(",")]
    order = [("frame", "vector", "sample").index(name) for name in names if name != "-"]
    data = rf().transpose(order).reshape([1 if name == "-" else rf().shape[order.pop(0)] for name in names])
    sweep = load_sweep(save(tmp_path, new, data=data), settings_of(rf="data", axes=axes))
    np.testing.assert_array_equal(frames_of(sweep), rf())


@VERSIONS
def test_iq_as_complex_numbers_and_as_two_arrays(tmp_path, new):
    echoes = matlab_order(iq())
    path = save(tmp_path, new, IQ=echoes, I=echoes.real, Q=echoes.imag)
    numbers = {"demodulation_frequency_hz": "Trans.frequency * 1e6"}
    for mapping in (settings_of(iq="IQ", **numbers), settings_of(i="I", q="Q", **numbers)):
        sweep = load_sweep(path, mapping)
        np.testing.assert_array_equal(frames_of(sweep), iq())
        assert sweep.signal.demodulation_frequency_hz == 6.25e6


@VERSIONS
def test_grey_levels_saved_as_double_with_positions(tmp_path, new):
    x, z = 0.2 * np.arange(VECTORS) - 0.5, 1e-3 * (3 + 0.1 * np.arange(SAMPLES))
    path = save(tmp_path, new, image=matlab_order(grey()).astype(float), x=x, z=z)
    arrays = {"bmode": "image", "axes": AXES, "x_mm": "x", "z_mm": "z * 1e3", "time_s": "t"}
    sweep = load_sweep(path, ImportSettings(arrays=arrays, dynamic_range_db=55.0))
    np.testing.assert_array_equal(frames_of(sweep), grey())
    assert sweep.frames.dtype == np.uint8
    assert sweep.signal == BModeSettings(55.0)
    expected = ImageGrid(VECTORS, SAMPLES, 0.2, 0.1, 3.0)
    assert sizes_of(sweep.grid) == pytest.approx(sizes_of(expected), rel=1e-12)


def test_an_element_of_an_array_of_structs(tmp_path):
    path = save(tmp_path, True)
    with h5py.File(path, "r+") as file:  # each field is a list of references, as MATLAB writes them
        for k in range(3):
            file[f"#refs#/s{k}"] = rf(k)
        file["Receive/data"] = np.array([[file[f"#refs#/s{k}"].ref] for k in range(3)], dtype=h5py.ref_dtype)
    np.testing.assert_array_equal(frames_of(load_sweep(path, settings_of(rf="Receive(2).data"))), rf(1))
    with pytest.raises(InvalidInputError, match=r"Receive\.data"):
        load_sweep(path, settings_of(rf="Receive.data"))
    structs = np.empty((1, 3), [("data", object)])
    for k in range(3):
        structs[0, k]["data"] = matlab_order(rf(k))
    old = load_sweep(save(tmp_path, Receive=structs), settings_of(rf="Receive(2).data"))
    np.testing.assert_array_equal(frames_of(old), rf(1))
