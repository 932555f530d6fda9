"""Packages of any sweep, written as the scanner writes them, are read back; what contradicts is named."""

import re
from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import IMPORT_SETTINGS, sweep_of
from sweep_examples import sizes_of

from speckle3d.cli.describe import describe
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.sweep import stored_dtype
from speckle3d.io.clarius.imu import read_samples
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.reader import sensor_of
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep

TIMES_S = examples.bursts_s(100.0, 102.0)


def require_equal(back, expected):
    assert back.frames.shape == expected.frames.shape
    for i in range(len(expected)):
        np.testing.assert_array_equal(back.frames[i], expected.frames[i])
    assert back.frames.dtype == expected.frames.dtype
    np.testing.assert_array_equal(back.frame_time_s, expected.frame_time_s)
    # Places are printed in elements and samples, and come back to rounding.
    assert sizes_of(back.grid) == pytest.approx(sizes_of(expected.grid), rel=1e-12)
    assert back.signal == expected.signal
    ours, reference = back.orientation, expected.orientation
    np.testing.assert_array_equal(ours.readings.time_s, reference.readings.time_s)
    difference = ours.readings.world_from_sensor.inv() * reference.readings.world_from_sensor
    assert difference.magnitude().max() < 1e-9
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        np.testing.assert_allclose(getattr(ours, name), getattr(reference, name), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("kind", ["rf", "iq", "env"])
@pytest.mark.parametrize(("is_packed", "place"), [(False, "folder"), (True, "package.tar")])
def test_what_is_written_is_read(tmp_path, kind, is_packed, place):
    sweep = sweep_of(kind)
    back = load_sweep(examples.write_package(tmp_path / place, sweep, lzop=is_packed), IMPORT_SETTINGS)
    require_equal(back, sweep)
    assert back.probe == "Clarius L7HD3"
    assert stored_dtype(back.frames) == (np.uint8 if kind == "env" else np.int16)


def test_an_archive_cut_short_is_no_recording(tmp_path):
    path = examples.write_package(tmp_path / "p.tar", sweep_of("rf"))
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises((FileError, InvalidInputError), match=r"p\.tar"):
        _ = load_sweep(path, IMPORT_SETTINGS)


def test_a_damaged_block_of_lzop_is_told(tmp_path):
    folder = examples.write_package(tmp_path / "p", sweep_of("rf"), lzop=True)
    (file,) = folder.glob("*.lzo")
    file.write_bytes(file.read_bytes()[:-50] + bytes(50))
    with pytest.raises(FileError, match="check sum"):
        load_sweep(folder, IMPORT_SETTINGS)


def test_rf_is_preferred_and_a_raw_file_gives_its_own_kind(tmp_path):
    rf, iq = sweep_of("rf"), sweep_of("iq")
    folder = examples.write_files(tmp_path / "both", examples.package_files(iq) | examples.package_files(rf))
    require_equal(load_sweep(folder, IMPORT_SETTINGS), rf)
    require_equal(load_sweep(folder / f"{examples.NAME}_iq.raw", IMPORT_SETTINGS), iq)


def test_a_file_without_its_package_names_what_lacks(tmp_path):
    name = f"{examples.NAME}_rf"
    files = examples.package_files(sweep_of("rf")) | {f"{name}.tgc": b"tgc"}
    folder = examples.write_files(tmp_path / "p", files)
    require_equal(load_sweep(folder / f"{name}.tgc", IMPORT_SETTINGS), sweep_of("rf"))
    (folder / f"{name}.raw").unlink()
    for suffix in (".tgc", ".yml"):
        with pytest.raises(InvalidInputError, match=re.escape(f"{name}{suffix}: expected {name}.raw beside")):
            load_sweep(folder / f"{name}{suffix}", IMPORT_SETTINGS)


def test_iq_of_a_falling_frequency_becomes_that_of_one(tmp_path):
    """Echoes of 7 MHz, shifted down by 9 to 6 MHz, are afterwards a constant frequency at all depths."""
    rate_hz, samples = 15e6, 600
    depth_mm = np.arange(samples) * 1540e3 / (2 * rate_hz)
    oscillator_hz = np.interp(depth_mm, [0, 40], [9e6, 6e6])
    phase = 2 * np.pi * (7e6 * np.arange(samples) - np.cumsum(oscillator_hz) + oscillator_hz / 2) / rate_hz
    sweep = sweep_of("iq", samples=samples)
    frames = np.tile(np.round(8000 * np.exp(1j * phase)), (len(sweep), 5, 1)).astype(np.complex64)
    sweep = replace(sweep, frames=frames, grid=replace(sweep.grid, first_sample_depth_mm=0.0))
    yml = examples.yml_text(sweep).split("focus:")[0] + examples.focus_text(9, 6)
    back = load_sweep(examples.write_package(tmp_path / "p.tar", sweep, yml=yml), IMPORT_SETTINGS)
    line = back.frames[1][2]
    turn_hz = np.angle(line[1:] * line[:-1].conj()) * rate_hz / (2 * np.pi)
    # Rounding of 8000 to whole numbers: 1e-4 rad, 200 Hz.
    np.testing.assert_allclose(turn_hz + back.signal.demodulation_frequency_hz, 7e6, atol=1e3)


def samples_of(tmp_path, text):
    path = tmp_path / "x_imu.yml"
    path.write_text(text)
    return read_samples(Member(path, path.name, 0, path.stat().st_size))


def off_deg(samples):
    (off,) = (value for name, value, _ in samples.rows if name == "quaternion, off the vertical")
    return float(off)


def moving(degrees=25.0):
    return examples.sensor_of(examples.sway(TIMES_S, degrees), TIMES_S)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_accelerometer_becomes_specific_force_whatever_its_sign(tmp_path, sign):
    sensor = moving()
    measured_as = replace(sensor, accelerometer_m_s2=sign * sensor.accelerometer_m_s2)
    samples = samples_of(tmp_path, examples.sensor_text(measured_as))
    assert off_deg(samples) < 0.6  # noise of 0.05 m/s^2 tilts by 0.4 deg
    np.testing.assert_allclose(
        samples.orientation.accelerometer_m_s2, sensor.accelerometer_m_s2, rtol=1e-12, atol=1e-14
    )
    apart = samples.world_from_sensor.inv() * sensor.readings.world_from_sensor
    assert apart.magnitude().max() < 1e-9


def test_a_quaternion_against_gravity_gives_no_orientation(tmp_path):
    """Scalar last, as other makers write it."""
    text = examples.sensor_text(moving())
    for old, new in (("q0", "qw"), ("q1", "q0"), ("q2", "q1"), ("q3", "q2"), ("qw", "q3")):
        text = text.replace(f"{old}:", f"{new}:")
    samples = samples_of(tmp_path, text)
    assert samples.orientation is None
    assert any("gravity" in remark for remark in samples.remarks)


@pytest.mark.parametrize("bad", ["scope x: .nan #", "timestamp: {\n"])
def test_a_bad_sample_costs_that_sample(tmp_path, bad):
    rows = examples.sensor_text(moving()).split("---\n")
    whole = samples_of(tmp_path, "---\n".join(rows))
    rows[7] = rows[7].replace("scope x: ", bad) if bad.startswith("scope") else bad
    samples = samples_of(tmp_path, "---\n".join(rows))
    np.testing.assert_array_equal(samples.time_s, np.delete(whole.time_s, 7))
    gyroscope, all_rows = (part.vectors["gyroscope_rad_s"] for part in (samples, whole))
    np.testing.assert_array_equal(gyroscope, np.delete(all_rows, 7, axis=0))
    assert any(f"1 of {len(rows)} left out" in remark for remark in samples.remarks)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "count", "norm", "off", "dip_deg"),
    [("carotid/carotid", 84, 0.921, 0.75, 73), ("wirephantom/phantom", 57, 0.955, 0.47, 61)],
)
def test_real_sensors(realdata, name, count, norm, off, dip_deg):
    samples = sensor_of(realdata / "clarius" / f"{name}_imu.yml")
    assert samples.time_s.size == count
    assert off_deg(samples) == pytest.approx(off, abs=0.01)
    assert any("negated" in value for _, value, _ in samples.rows)
    orientation = samples.orientation
    assert np.median(np.linalg.norm(orientation.accelerometer_m_s2, axis=1)) == pytest.approx(
        norm * 9.80665, abs=0.01
    )
    x, y, z = orientation.readings.world_from_sensor.apply(orientation.magnetometer_au).mean(axis=0)
    assert np.rad2deg(np.arctan2(-z, np.hypot(x, y))) == pytest.approx(dip_deg, abs=1)
    assert abs(np.rad2deg(np.arctan2(y, x))) < 8


@pytest.mark.realdata
def test_real_packages(realdata):
    for name, frames in (("carotid", "17"), ("wirephantom", "13")):
        assert ("rf: frames", frames, "") in describe(realdata / "clarius" / name)
    doppler = realdata / "clarius" / "carotid" / "doppler"
    with pytest.raises(InvalidInputError, match="steered"):
        load_sweep(doppler)
    settings = ImportSettings(vector_pitch_mm=0.1, dynamic_range_db=60.0)
    envelope = load_sweep(doppler / "carotid_env.raw", settings)
    assert envelope.frames.shape == (1, 304, 592)
    assert envelope.frames[0].max() == 255
    assert envelope.frame_time_s[0] == pytest.approx(272.547324170, abs=1e-9)
    # 592 samples of 0.0513 mm; the depth is counted from the first but for one of its 16 delay samples.
    assert envelope.grid.depth_mm == pytest.approx(0.051 + 591 * 0.051333, abs=0.01)


def test_lines_of_a_curved_array_spread_by_its_radius(tmp_path):
    sweep = sweep_of("rf")
    yml = examples.yml_text(sweep) + "probe: {radius: 45 mm, pitch: 0.35 mm, elements: 192}\n"
    path = examples.write_package(tmp_path / "folder", sweep, yml=yml)
    grid = load_sweep(path, IMPORT_SETTINGS.model_copy(update={"probe": None})).grid
    assert grid.fan.radius_mm == 45.0
    # Lines lie where their elements do; the middle of 192 elements looks straight down.
    elements = np.arange(grid.vectors) * sweep.grid.vector_pitch_mm / examples.ELEMENT_MM
    np.testing.assert_allclose(grid.angle_rad(np.arange(grid.vectors)), (elements - 95.5) * 0.35 / 45.0)


def test_a_curved_model_without_its_radius_is_asked_for_it(tmp_path):
    path = examples.write_package(tmp_path / "folder", sweep_of("rf"))
    curved_probe = IMPORT_SETTINGS.model_copy(update={"probe": "Clarius C3 HD3", "element_pitch_mm": 0.35})
    with pytest.raises(MissingSettingsError) as error:
        load_sweep(path, curved_probe)
    assert set(error.value.settings) == {"array_radius_mm", "line_angles_deg"}
    settings = {"array_radius_mm": 45.0, "line_angles_deg": (-3.0, 3.0)}
    grid = load_sweep(path, curved_probe.model_copy(update=settings)).grid
    np.testing.assert_allclose(np.rad2deg(grid.angle_rad([0, grid.vectors - 1])), [-3.0, 3.0])
