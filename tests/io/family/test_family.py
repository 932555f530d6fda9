"""What is wrong in a file of the family is named by file and place in one line; the family's own ways."""

import h5py
import numpy as np
import old_files
import pytest

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.family.calibrations import read_calibration
from speckle3d.io.family.curves import read_curves
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.load import load_sweep

READ = {
    "rf": load_sweep,
    "curves": read_curves,
    "calibration": read_calibration,
    "reconstruction": read_reconstruction,
}


def drop(name):
    return lambda file: file.__delitem__(name)


def attribute(node, name, value):
    return lambda file: file[node].attrs.__setitem__(name, value)


def entry(node, index, value):
    return lambda file: file[node].__setitem__(index, value)


def replacement(node, value):
    def edit(file):
        attributes = dict(file[node].attrs)
        del file[node]
        file[node] = value
        if isinstance(value, np.ndarray):
            file[node].attrs.update(attributes)

    return edit


WRONG = {
    "rf": [
        (drop("rf"), "rf, iq or bmode"),
        (replacement("frame_time_s", np.arange(3.0)), "/rf"),
        (entry("frame_time_s", 2, 0.0), r"frame_time_s\[2\]"),
        (entry("tracker/world_from_sensor", 2, np.diag([1, 1, -1, 1])), r"/world_from_sensor\[2\]"),
        (attribute("rf", "sampling_rate_hz", "fast"), "/rf.*sampling_rate_hz"),
        (attribute("/", "version", 4), "version"),
        (replacement("frame_time_s", h5py.ExternalLink("/etc/passwd", "/x")), "/frame_time_s"),
    ],
    "calibration": [
        (entry("covariance", (1, 1), -1.0), "/covariance"),
    ],
    "curves": [(entry("depth_mm", 1, 5.0), "/depth_mm")],
    "reconstruction": [
        (entry("poses/image", (3, 1, 1), 7.0), r"/poses/image\[3\]"),
    ],
}
CASES = [(kind, edit, message) for kind, rows in WRONG.items() for edit, message in rows]


@pytest.mark.parametrize(("kind", "edit", "message"), CASES, ids=range(len(CASES)))
def test_what_is_wrong_is_named_in_one_line(tmp_path, kind, edit, message):
    path = tmp_path / "bad.h5"
    path.write_bytes((old_files.FOLDER / f"{kind}.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(InvalidInputError, match=message) as error:
        READ[kind](path)
    assert str(error.value).count(str(path)) == 1
    assert "\n" not in str(error.value)


def test_curves_of_earlier_versions_are_read(tmp_path):
    path = tmp_path / "c.h5"
    path.write_bytes((old_files.FOLDER / "curves.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        for name in ("correlation_of", "edge_fraction", "probe", "scale_sigma", "origin"):
            del file.attrs[name]
        del file["tilt"], file["speckle"]
    curves = read_curves(path)
    assert (curves.key.correlation_of, curves.key.edge_fraction, curves.key.probe) == ("intensity", 0.1, "")
    assert (curves.origin, curves.tilt, curves.speckle) == ("phantom", None, None)
