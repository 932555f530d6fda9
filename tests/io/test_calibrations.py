from dataclasses import replace

import numpy as np
import pytest
import sweep_examples
from calibration_files import made
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from speckle3d.core.calibration import FramesUsed, Parameter, Source
from speckle3d.core.errors import MismatchError
from speckle3d.io.calibrations import apply_calibrations, read_calibration, write_calibration
from speckle3d.io.describe import describe
from speckle3d.io.hdf5 import sha256_of

PLAIN = ("method", "sensor", "parameters", "rms", "rms_unit", "condition_number", "frames", "time_offset_s",
         "verdict", "source")  # fmt: skip

# HDF5 holds no NUL and UTF-8 no surrogates.
texts = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20)
numbers = st.floats(-1e6, 1e6)
spreads = st.one_of(st.floats(0, 1e6), st.just(np.inf))


def array(size, elements=numbers):
    return st.lists(elements, min_size=size, max_size=size).map(np.array)


@st.composite
def calibrations(draw):
    turned = draw(st.booleans())
    size = 3 if turned else 6
    root = draw(array(size * size, st.floats(-10, 10))).reshape(size, size)
    frames = FramesUsed(9, (0, 3), {n: draw(texts) for n in draw(st.sets(st.integers(4, 8)))})
    return replace(
        made("orientation" if turned else "tracker"),
        rotation=Rotation.random(rng=np.random.default_rng(draw(st.integers(0, 2**32 - 1)))),
        translation_mm=None if turned else draw(array(3)),
        covariance=root @ root.T,
        parameters=tuple(draw(st.lists(st.builds(Parameter, texts, numbers, spreads, texts), max_size=4))),
        condition_number=draw(st.one_of(st.floats(1, 1e12), st.just(np.inf))),
        frames=frames,
        time_offset_s=draw(st.none() | st.floats(-10, 10)),
        verdict=draw(texts),
        source=draw(st.builds(Source, texts, texts, texts, texts)),
    )


def require_same(got, written):
    for name in PLAIN:
        assert getattr(got, name) == getattr(written, name), name
    for name in ("translation_mm", "pixel_mm", "covariance"):
        a, b = getattr(got, name), getattr(written, name)
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_array_equal(a, b)
    # A matrix of rounded numbers is made a rotation again: a few times the precision of a double.
    assert (got.rotation.inv() * written.rotation).magnitude() < 1e-14 * 100


@pytest.fixture
def path(tmp_path):
    write_calibration(tmp_path / "cal.h5", made())
    return tmp_path / "cal.h5"


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(written=calibrations())
def test_a_calibration_comes_back(tmp_path, written):
    write_calibration(tmp_path / "c.h5", written)
    require_same(read_calibration(tmp_path / "c.h5"), written)


def test_both_sensors_are_calibrated_from_their_files_and_the_files_told(path):
    turn = path.with_name("turn.h5")
    write_calibration(turn, made("orientation"))
    sweep, held = apply_calibrations(sweep_examples.rf_sweep(), [path, turn])
    assert (sweep.tracker.sensor_from_image.rotation.inv() * made().rotation).magnitude() < 1e-12
    assert (sweep.orientation.sensor_from_image.inv() * made().rotation).magnitude() < 1e-12
    assert [(one.sensor, one.path, one.sha256) for one in held] == [
        ("tracker", str(path), sha256_of(path)),
        ("orientation", str(turn), sha256_of(turn)),
    ]


def test_two_for_one_sensor_or_one_for_none_are_refused_with_the_file(path):
    again = path.with_name("again.h5")
    write_calibration(again, made())
    with pytest.raises(MismatchError, match=r"again\.h5"):
        apply_calibrations(sweep_examples.rf_sweep(), [path, again])
    with pytest.raises(MismatchError, match=r"cal\.h5: example"):
        apply_calibrations(replace(sweep_examples.rf_sweep(), tracker=None), [path])


def test_a_trackers_calibration_is_described_for_people(path):
    rows = {name: (value, unit) for name, value, unit in describe(path)}
    assert rows["format"] == ("speckle3d.calibration", "")
    assert rows["sensor"] == ("tracker", "")
    angles = [rows[f"sensor_from_image {name}"] for name in ("roll", "yaw", "tilt")]
    assert angles == [("-0.550", "deg"), ("44.220", "deg"), ("-90.370", "deg")]
    assert rows["sensor_from_image x, y, z"] == ("-270.860, 4.860, -65.080", "mm")
    assert rows["parameter gamma"] == ("28.648 +- 0.573", "deg")
    assert rows["frames used"] == ("4 of 9", "")
    assert rows["dropped: no line"] == ("2", "frames")
    assert rows["verdict"] == ("The motion was sufficient.", "")
    assert rows["input"] == ("plane.mha", "")
