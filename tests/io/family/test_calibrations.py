from dataclasses import replace

import numpy as np
import pytest
import sweep_examples
from calibration_files import example_calibration

from speckle3d.calibration_files import apply_calibrations
from speckle3d.core.errors import MismatchError
from speckle3d.io.family.calibrations import write_calibration
from speckle3d.io.hdf5 import sha256_of


@pytest.fixture
def path(tmp_path):
    write_calibration(tmp_path / "cal.h5", example_calibration())
    return tmp_path / "cal.h5"


def test_a_calibration_file_for_each_sensor(path):
    turn = path.with_name("turn.h5")
    write_calibration(turn, example_calibration("orientation"))
    sweep, files = apply_calibrations(sweep_examples.rf_sweep(), [path, turn])
    off = sweep.tracker.sensor_from_image.inv() * example_calibration().sensor_from_image
    np.testing.assert_allclose(off.as_matrix(), np.eye(4), atol=1e-9)
    assert (sweep.orientation.sensor_from_image.inv() * example_calibration().rotation).magnitude() < 1e-12
    assert [(file.sensor, file.path, file.sha256) for file in files] == [
        ("tracker", str(path), sha256_of(path)),
        ("orientation", str(turn), sha256_of(turn)),
    ]


def test_two_for_one_sensor_or_one_for_none_are_refused_with_the_file(path):
    again = path.with_name("again.h5")
    write_calibration(again, example_calibration())
    with pytest.raises(MismatchError, match=r"again\.h5"):
        apply_calibrations(sweep_examples.rf_sweep(), [path, again])
    with pytest.raises(MismatchError, match=r"cal\.h5: example"):
        apply_calibrations(replace(sweep_examples.rf_sweep(), tracker=None), [path])
