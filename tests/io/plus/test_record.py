"""The group /plus of a sweep file: damaged or made by others, it is one clear line and no other header."""

import h5py
import numpy as np
import pytest
from image_examples import grey, tracked, write_mha

from speckle3d.core.errors import Speckle3DError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.io.plus.write import write_sequence
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.io.sweeps import read_sweep

TEXT = h5py.string_dtype()
BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)


@pytest.fixture
def path(tmp_path):
    frames = tracked(3)[2]
    frames[1]["Comment"] = "here"
    source = write_mha(tmp_path / "in.mha", grey(), {"Custom": "a"}, frames)
    write_sweep(tmp_path / "sweep.h5", load_sweep(source, BMODE))
    return tmp_path / "sweep.h5"


def put(name, values, dtype=None):
    def change(file):
        group = file["plus"]
        if name in group:
            del group[name]
        group.create_dataset(name, data=values, dtype=dtype)

    return change


def test_what_is_there(path):
    with h5py.File(path) as file:
        group = file["plus"]
        assert group["frames/ProbeToTrackerTransform"].shape == (3, 4, 4)
        np.testing.assert_array_equal(group["frames/Timestamp"], [5.0, 5.1, 5.2])
        assert group["frames/Comment"].asstr()[()].tolist() == ["", "here", ""]
        assert group["present/Comment"][()].tolist() == [False, True, False]
        assert group.attrs["poses"] == "ProbeToTracker ReferenceToTracker"
        names = group["field_names"].asstr()[()].tolist()
        assert group["field_values"].asstr()[names.index("Custom")] == "a"


@pytest.mark.parametrize(
    "change",
    [
        put("field_names", ["Custom\nElementDataFile = /etc/passwd"] * 2, TEXT),
        put("field_values", ["a\nDimSize = 9 9 9"] * 2, TEXT),
        put("frames/Comment", ["a", "b\rElementDataFile = x", "c"], TEXT),
        put("frames/Co = mment", ["a", "b", "c"], TEXT),
        put("frames/Comment", ["a", "b"], TEXT),
        put("frames/Timestamp", np.zeros((3, 2))),
        put("frames/Timestamp", np.zeros(3, np.int64)),
        put("frames/ProbeToTrackerTransform", np.zeros((3, 16))),
        put("present/Comment", [1.0, 2.0, 3.0]),
        put("present/Comment", [True]),
        put("frames", [1.0]),
        lambda file: file["plus"].attrs.pop("poses"),
        lambda file: file["plus"].attrs.__setitem__("conjugated", "yes"),
        lambda file: file.__delitem__("plus/field_values"),
        lambda file: file["plus"].__setitem__("frames/Other", h5py.ExternalLink("/etc/passwd", "/")),
        lambda file: file["plus"].__setitem__("frames/Other", h5py.SoftLink("/nowhere")),
    ],
)
def test_what_does_not_make_sense_is_named(path, tmp_path, change):
    with h5py.File(path, "r+") as file:
        # As many fields as names that a case gives.
        for name in ("field_names", "field_values"):
            kept = file["plus"][name].asstr()[:2].tolist()
            del file["plus"][name]
            file["plus"].create_dataset(name, data=kept, dtype=TEXT)
        change(file)
    sweep = read_sweep(path)  # of which the group is no part
    with pytest.raises(Speckle3DError, match=r"sweep\.h5: /plus") as caught:
        write_sequence(tmp_path / "out.mha", sweep)
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "out.mha").exists()


def test_fields_of_another_number_of_images_are_left_out(path, tmp_path):
    with h5py.File(path, "r+") as file:
        for name in ("bmode", "frame_time_s"):
            kept, attributes = file[name][:2], dict(file[name].attrs)
            del file[name]
            file[name] = kept
            file[name].attrs.update(attributes)
    left_out = write_sequence(tmp_path / "out.mha", read_sweep(path))
    assert left_out[0] == "the fields of 3 images, where the sweep has 2"
    assert len(load_sweep(tmp_path / "out.mha")) == 2


def test_a_sweep_file_copied_keeps_them(path, tmp_path):
    write_sweep(tmp_path / "copy.h5", read_sweep(path))
    assert write_sequence(tmp_path / "out.mha", read_sweep(tmp_path / "copy.h5")) == []
    assert b"Seq_Frame0001_Comment = here\n" in (tmp_path / "out.mha").read_bytes()
