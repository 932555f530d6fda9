"""What is wrong in a sweep, calibration or curves file is named by file, place and index in one line."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import speckle
import sweep_examples
from calibration_files import made
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from speckle3d.core.curves import SpeckleSize, TiltResponse
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.io.calibrations import read_calibration, write_calibration
from speckle3d.io.curves import read_curves, write_curves
from speckle3d.io.describe import describe
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.io.sweeps import read_sweep

TILT = TiltResponse(np.array([-7.5, 11.0]), np.array([1.5, 7.25]))
SIZE = SpeckleSize(np.array([0.3, 0.4]), np.array([0.07, 0.08]))
KINDS = {
    "sweep": (lambda path: write_sweep(path, sweep_examples.rf_sweep()), read_sweep),
    "calibration": (lambda path: write_calibration(path, made()), read_calibration),
    "curves": (
        lambda path: write_curves(
            path, replace(speckle.curves(sigma_mm=[0.3, 0.6]), tilt=TILT, speckle=SIZE)
        ),
        read_curves,
    ),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    for kind, (write, _) in KINDS.items():
        write(folder / f"{kind}.h5")
    return {kind: (folder / f"{kind}.h5").read_bytes() for kind in KINDS}


def drop(*names):
    return lambda file: [file.__delitem__(name) for name in names]


def lose(node, name):
    return lambda file: file[node].attrs.__delitem__(name)


def attribute(node, name, value):
    return lambda file: file[node].attrs.__setitem__(name, value)


def entry(node, index, value):
    return lambda file: file[node].__setitem__(index, value)


def changed(node, change):
    def edit(file):
        kept, values = dict(file[node].attrs), change(file[node][()])
        del file[node]
        file[node] = values
        file[node].attrs.update(kept)

    return edit


def replaced(node, value):
    return changed(node, lambda _: value)


FAMILY = [
    (attribute("/", "version", 3), r"version 1.*got 3"),
    (
        attribute("/", "format", "speckle3d.other"),
        r"'speckle3d\.(sweep|calibration|curves)'.*'speckle3d\.other'",
    ),
    (lose("/", "version"), "/.*version"),
    (lose("/", "format"), "/.*format"),
]
WRONG = {
    "sweep": [
        (drop("rf"), r"/.*rf or bmode"),
        *((drop(name), f"/{name}") for name in (
            "frame_time_s", "orientation/time_s", "tracker/world_from_sensor", "truth/world_from_image")),
        (replaced("rf", np.zeros((6, 5, 40))), r"/rf"),
        (replaced("rf", np.zeros((6, 200), np.int16)), r"/rf.*\(frame, vector, sample\)"),
        (replaced("rf", np.zeros((0, 5, 40), np.int16)), r"/rf.*\(frame, vector, sample\)"),
        (replaced("frame_time_s", np.arange(5.0)), r"/frame_time_s.*\(6,\).*\(5,\)"),
        (replaced("frame_time_s", [b"a"] * 6), r"/frame_time_s"),
        (entry("frame_time_s", 3, np.nan), r"/frame_time_s\[3\]"),
        (entry("frame_time_s", 4, 10.0), r"/frame_time_s\[4\]"),
        (entry("orientation/time_s", 7, 0.0), r"/orientation/time_s\[7\]"),
        (entry("tracker/time_s", 2, np.inf), r"/tracker/time_s\[2\]"),
        (entry("orientation/quaternion_wxyz", 5, [2, 0, 0, 0]), r"/quaternion_wxyz\[5\]"),
        (entry("orientation/quaternion_wxyz", (5, 2), np.nan), r"/quaternion_wxyz\[\(5, 2\)\]"),
        (entry("orientation/quaternion_wxyz", (5, 0), 1e300), r"/quaternion_wxyz\[5\]"),
        (replaced("orientation/quaternion_wxyz", np.zeros((18, 3))), r"/quaternion_wxyz.*\(18, 4\)"),
        (entry("orientation/gyroscope_rad_s", (3, 1), np.nan), r"/gyroscope_rad_s\[\(3, 1\)\]"),
        (entry("tracker/world_from_sensor", (4, 0, 0), 9.0), r"/world_from_sensor\[4\]"),
        (entry("tracker/world_from_sensor", 4, np.diag([1, 1, -1, 1])), r"/world_from_sensor\[4\]"),
        (entry("truth/world_from_image", (2, 3, 3), 2.0), r"/truth/world_from_image\[2\]"),
        (entry("truth/world_from_image", (2, 0, 0), 1e300), r"/truth/world_from_image\[2\]"),
        (entry("tracker/valid", slice(None), False), r"/tracker/valid"),
        (replaced("tracker/valid", np.ones(4, bool)), r"/tracker/valid.*\(18,\).*\(4,\)"),
        *((lose("rf", name), f"/rf.*{name}") for name in (
            "vector_pitch_mm", "bandwidth_hz", "first_sample_depth_mm")),
        (attribute("rf", "vector_pitch_mm", 0.0), r"/rf: vector_pitch_mm"),
        (attribute("rf", "sampling_rate_hz", -1.0), r"/rf: sampling_rate_hz"),
        (attribute("rf", "sampling_rate_hz", "fast"), r"/rf attribute sampling_rate_hz"),
        (attribute("rf", "vector_pitch_mm", np.nan), r"/rf attribute vector_pitch_mm"),
        (attribute("rf", "bandwidth_hz", 4e6), r"/rf attribute bandwidth_hz"),
        (attribute("rf", "bandwidth_hz", [8e6, 4e6]), r"/rf: bandwidth_hz"),
        (attribute("orientation", "sensor_from_image_wxyz", [1, 1, 0, 0]), r"/orientation .*unit quaternion"),
        (attribute("tracker", "sensor_from_image", np.zeros((4, 4))), r"/tracker .*rigid 4x4"),
        (attribute("tracker", "time_offset_s", np.nan), r"/tracker attribute time_offset_s"),
    ],
    "calibration": [
        *((drop(name), f": /{name}") for name in (
            "covariance", "parameters", "parameters/name", "parameters/value", "parameters/standard_error",
            "parameters/unit", "frames", "frames/used", "frames/dropped", "frames/reason", "source")),
        (drop("sensor_from_image"), ": /sensor_from_image_wxyz"),
        *((lose("/", name), name) for name in (
            "method", "sensor", "rms", "rms_unit", "condition_number", "verdict")),
        (lose("frames", "given"), "given"),
        *((lose("source", name), name) for name in (
            "input_path", "input_sha256", "package_version", "settings_json")),
        (changed("sensor_from_image", lambda a: 1.01 * a), "/sensor_from_image"),
        (changed("sensor_from_image", lambda a: a @ np.diag([1, 1, -1, 1])), "/sensor_from_image"),
        (changed("sensor_from_image", lambda a: a * np.nan), "/sensor_from_image"),
        (changed("sensor_from_image", lambda a: a[:3]), r"/sensor_from_image.*\(4, 4\).*\(3, 4\)"),
        (changed("pixel_mm", lambda a: -a), "pixel_mm"),
        (changed("pixel_mm", lambda a: a[:1]), r"/pixel_mm.*\(2,\).*\(1,\)"),
        (changed("covariance", lambda a: a[:3, :3]), r"/covariance.*\(6, 6\).*\(3, 3\)"),
        (changed("covariance", lambda a: -a), r"/covariance\[0\]"),
        (changed("covariance", lambda a: a + np.nan), "/covariance"),
        (changed("covariance", lambda a: np.where(np.eye(6), a, np.nan)), "/covariance"),
        (changed("parameters/value", lambda a: a * np.nan), r"/parameters/value\[0\]"),
        (changed("parameters/value", lambda a: a[:1]), r"/parameters/standard_error.*\(1,\).*\(2,\)"),
        (changed("parameters/standard_error", lambda a: -a), r"/parameters/standard_error\[0\]"),
        (changed("parameters/name", lambda a: a[:1]), "/parameters/name.*2"),
        (replaced("parameters/name", np.arange(2)), "/parameters/name.*2"),
        (changed("frames/used", lambda a: a + 5), r"/frames/used\[2\].*9.*9"),
        (changed("frames/dropped", lambda a: -a), r"/frames/dropped\[0\].*9.*-2"),
        (changed("frames/used", lambda a: a + 0.5), "/frames/used"),
        (changed("frames/reason", lambda a: a[:1]), "/frames/reason.*3"),
        (attribute("/", "sensor", "camera"), "sensor.*'camera'"),
        *((attribute("/", "rms", value), "rms") for value in (np.nan, "small")),
        *((attribute("/", "condition_number", value), "condition_number") for value in (
            np.nan, "good", [1.0, 2.0])),
        (attribute("/", "time_offset_s", np.inf), "time_offset_s"),
        (attribute("/", "verdict", 1), "verdict"),
    ],
    "curves": [
        *((drop(name), f": /{name}") for name in (
            "depth_mm", "distance_mm", "correlation", "cells", "tilt/pivot_mm", "tilt/spread_mm",
            "speckle/lateral_mm", "speckle/axial_mm")),
        *((lose("/", name), name) for name in (
            "vector_pitch_mm", "patch_width_mm", "patch_height_mm", "equalise_mm", "signal",
            "sampling_rate_hz", "speed_of_sound_m_s", "centre_frequency_hz", "bandwidth_hz")),
        (changed("correlation", lambda a: a[:, :-1]), r"/correlation.*\(2, 201\).*\(2, 200\)"),
        (changed("correlation", lambda a: 1.5 * a), "correlation"),
        (changed("correlation", lambda a: a[:, ::-1]), "one that rises"),
        (changed("depth_mm", lambda a: a[::-1]), "/depth_mm"),
        (changed("depth_mm", lambda a: a * np.nan), r"/depth_mm\[0\]"),
        (changed("distance_mm", lambda a: a + 1), "distance_mm"),
        (changed("cells", lambda a: -a), "cells"),
        (changed("cells", lambda a: a[:1]), r"/cells.*\(2,\).*\(1,\)"),
        (changed("cells", lambda a: a.astype("S8")), "/cells"),
        (changed("tilt/pivot_mm", lambda a: a[:1]), r"/tilt/pivot_mm.*\(2,\).*\(1,\)"),
        (changed("tilt/pivot_mm", lambda a: a * np.nan), "pivot_mm"),
        (changed("tilt/spread_mm", lambda a: a + np.inf), "spread_mm"),
        (changed("tilt/spread_mm", lambda a: a.astype("S8")), "/tilt/spread_mm"),
        (changed("speckle/lateral_mm", lambda a: a * np.nan), "lateral_mm"),
        (changed("speckle/axial_mm", lambda a: -a), "axial_mm: expected speckle sizes above zero"),
        (attribute("/", "probe", 3.0), "probe"),
        (attribute("/", "edge_fraction", "wide"), "edge_fraction"),
        (attribute("/", "signal", "video"), "'rf'.*'bmode'.*'video'"),
        (attribute("/", "correlation_of", "amplitude"), "correlation_of.*'ampl"),
        (attribute("/", "correlation_of", 3.0), "correlation_of"),
        (attribute("/", "sampling_rate_hz", np.nan), "sampling_rate_hz"),
        (attribute("/", "bandwidth_hz", (9e6, 4e6)), "bandwidth_hz"),
    ],
}  # fmt: skip
CASES = [(kind, edit, message) for kind, rows in WRONG.items() for edit, message in [*rows, *FAMILY]]


@pytest.mark.parametrize(("kind", "edit", "message"), CASES, ids=[f"{kind}-{m}" for kind, _, m in CASES])
def test_what_is_wrong_is_named_in_one_line(tmp_path, whole, kind, edit, message):
    path = tmp_path / "bad.h5"
    path.write_bytes(whole[kind])
    with h5py.File(path, "r+") as file:
        edit(file)
    with pytest.raises(InvalidInputError, match=message) as caught:
        KINDS[kind][1](path)
    assert str(caught.value).count(str(path)) == 1
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("content", [b"", b"text", b"\x89HDF\r\n\x1a\n" + bytes(200)])
def test_what_is_not_hdf5_is_a_file_error(tmp_path, kind, content):
    _, read = KINDS[kind]
    (tmp_path / "a.h5").write_bytes(content)
    with pytest.raises(FileError, match=r"a\.h5: "):
        read(tmp_path / "a.h5")
    with pytest.raises(FileError, match="expected a file, got none"):
        read(tmp_path / "none.h5")
    with pytest.raises(FileError, match="expected a file, got a folder"):
        read(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=40)
@given(kept=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_a_file_error_wherever_it_ends(whole, kind, tmp_path_factory, kept):
    path = tmp_path_factory.mktemp("cut") / "cut.h5"
    path.write_bytes(whole[kind][: int(kept * len(whole[kind]))])
    with pytest.raises(FileError, match=r"cut\.h5: "):
        KINDS[kind][1](path)


@pytest.mark.parametrize("kind", ["calibration", "curves"])
@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_an_error_of_one_line_or_harmless(whole, kind, tmp_path, data):
    damaged = bytearray(whole[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "damaged.h5").write_bytes(damaged)
    try:
        KINDS[kind][1](tmp_path / "damaged.h5")
        describe(tmp_path / "damaged.h5")
    except Speckle3DError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either outcome is right


@pytest.mark.parametrize("kind", KINDS)
def test_an_unwritable_place_is_a_file_error(tmp_path, kind):
    write, _ = KINDS[kind]
    with pytest.raises(FileError, match="folder"):
        write(tmp_path / "none" / "a.h5")
    with pytest.raises(FileError, match="ordinary file"):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []
