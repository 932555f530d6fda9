"""Packages of any sweep, written as the scanner writes them, are read back equal in every field."""

import pickle
import sys
from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import GIVEN, sweep_of
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.sweep import ImageGrid, RFSettings, stored_dtype
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.raw import RawFile, RawFrames, read_header
from speckle3d.io.clarius.reader import sensor_of
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import companion_files, import_notes, load_sweep
from speckle3d.io.sweep_writer import write_sweep

SECOND = f"{{rx element: {0.3 / examples.ELEMENT_MM!r}"


def require_equal(found, expected):
    assert found.frames.shape == expected.frames.shape
    for i in range(len(expected)):
        assert found.frames[i].dtype == found.frames.dtype == expected.frames.dtype
        np.testing.assert_array_equal(found.frames[i], expected.frames[i])
    np.testing.assert_array_equal(found.frame_time_s, expected.frame_time_s)
    # Places are printed in elements and samples, and come back to rounding.
    for name, value in vars(expected.grid).items():
        assert getattr(found.grid, name) == pytest.approx(value, rel=1e-12), name
    assert found.signal == expected.signal
    require_equal_sensor(found.orientation, expected.orientation)


def require_equal_sensor(found, expected):
    np.testing.assert_array_equal(found.readings.time_s, expected.readings.time_s)
    apart = found.readings.world_from_sensor.inv() * expected.readings.world_from_sensor
    assert apart.magnitude().max() < 1e-9
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-14)
    assert found.sensor_from_image is None
    assert found.time_offset_s == 0.0


@pytest.mark.parametrize("kind", ["rf", "iq", "env"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("place", ["package.tar", "folder"])
def test_what_is_written_is_read(tmp_path, kind, packed, place):
    sweep = sweep_of(kind)
    package = examples.write_package(tmp_path / place, sweep, packed=packed)
    found = load_sweep(package, GIVEN)
    require_equal(found, sweep)
    assert found.probe == "Clarius L7HD3"
    assert found.frames.stored_dtype == (np.uint8 if kind == "env" else np.int16)


def test_tar_with_sub_folders_and_hidden_files(tmp_path):
    sweep = sweep_of("rf")
    files = {f"./exam/{name}": content for name, content in examples.package_files(sweep).items()}
    files[f"./exam/._{examples.NAME}_rf.raw"] = b"of a file manager"
    require_equal(load_sweep(examples.write_files(tmp_path / "x.tar", files), GIVEN), sweep)


def test_rf_is_preferred_and_a_raw_file_gives_its_own_kind(tmp_path):
    rf, iq = sweep_of("rf"), sweep_of("iq")
    files = examples.package_files(iq) | examples.package_files(rf)
    folder = examples.write_files(tmp_path / "both", files)
    require_equal(load_sweep(folder, GIVEN), rf)
    raw = folder / f"{examples.NAME}_iq.raw"
    require_equal(load_sweep(raw, GIVEN), iq)
    assert {each.name.split("_")[1] for each in companion_files(raw)} == {
        "iq.yml",
        "iq.tgc",
        "rf.tgc",
        "imu.yml",
    }
    rows = dict(row[:2] for row in describe(folder))
    assert (rows["sweep is made from"], rows["other raw files"]) == ("rf", "iq")


def test_the_type_decides_not_the_name(tmp_path):
    """Newer software may call I/Q rf.raw."""
    sweep = sweep_of("iq")
    package = examples.write_package(tmp_path / "p", sweep, kind="rf", yml_kind="iq")
    require_equal(load_sweep(package, GIVEN), sweep)


def test_all_that_is_missing_is_asked_for_at_once(tmp_path):
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(examples.write_package(tmp_path / "rf", sweep_of("rf")))
    assert caught.value.settings == ("probe", "bandwidth_hz")
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(examples.write_package(tmp_path / "env", sweep_of("env")))
    assert caught.value.settings == ("probe", "dynamic_range_db")


def test_settings_replace_what_the_package_says(tmp_path):
    package = examples.write_package(tmp_path / "p", sweep_of("iq"))
    given = ImportSettings(
        vector_pitch_mm=0.4, bandwidth_hz=(3e6, 7e6), demodulation_frequency_hz=5e6,
        centre_frequency_hz=5.5e6, speed_of_sound_m_s=1500.0, first_sample_depth_mm=1.25,
        sampling_rate_hz=14e6,
    )  # fmt: skip
    found = load_sweep(package, given)
    assert found.signal == RFSettings(14e6, 1500.0, 5.5e6, (3e6, 7e6), 5e6)
    spacing = found.signal.sample_spacing_mm
    assert vars(found.grid) == vars(ImageGrid(5, 40, 0.4, spacing, 1.25))


def curve(gain):
    return ((0.0, 20.0), (40.0, gain))


def test_the_same_gain_leaves_the_samples_as_they_are(tmp_path):
    sweep = sweep_of("rf")
    package = examples.write_package(tmp_path / "p", sweep, tgc=[curve(30.0)] * len(sweep))
    require_equal(load_sweep(package, GIVEN), sweep)
    assert "same in all frames" in dict(row[:2] for row in describe(package))["gain by frame"]


@pytest.mark.parametrize("kind", ["rf", "iq"])
def test_differing_gain_is_undone_relative_to_the_first_frame(tmp_path, kind):
    sweep = sweep_of(kind, frames=3)
    depth_mm = sweep.grid.first_sample_depth_mm + sweep.grid.sample_spacing_mm * np.arange(40)
    gains = [20 + depth_mm / 40 * (last - 20) for last in (30.0, 36.0, 24.0)]
    louder = [10 ** ((gain - gains[0]) / 20) for gain in gains]
    recorded = replace(sweep, frames=np.stack([sweep.frames[i] * louder[i] for i in range(3)]))
    curves = [curve(last) for last in (30.0, 36.0, 24.0)]
    package = examples.write_package(tmp_path / "p", recorded, tgc=curves)
    found = load_sweep(package, GIVEN)
    assert found.frames.dtype == stored_dtype(found.frames) == (np.float32 if kind == "rf" else np.complex64)
    for i in range(3):
        # The scanner rounds to whole numbers, which is then divided by the gain.
        np.testing.assert_allclose(found.frames[i], sweep.frames[i], atol=0.75)
    assert "undone" in dict(row[:2] for row in describe(package))["gain by frame"]
    again = pickle.loads(pickle.dumps(found.frames))
    np.testing.assert_array_equal(again[-1], found.frames[2])


def test_equal_gain_curves_are_one_and_no_array_is_held_for_a_frame(tmp_path):
    sweep = sweep_of("rf", frames=4)
    curves = [curve(last) for last in (30.0, 36.0, 30.0, 36.0)]
    frames = load_sweep(examples.write_package(tmp_path / "p", sweep, tgc=curves), GIVEN).frames
    held = frames.factors
    assert held.curves[0] is held.curves[2]
    assert held.curves[1] is held.curves[3]
    assert held.depth_mm.shape == (40,)
    np.testing.assert_array_equal(held[2], np.ones(40))
    assert len(pickle.dumps(frames)) < 2000


def test_gain_of_another_kind_serves_all(tmp_path):
    sweep = sweep_of("rf", frames=2)
    files = examples.package_files(sweep, tgc=[curve(30.0), curve(50.0)])
    files = {name.replace("_rf.tgc", "_env.tgc.yml"): content for name, content in files.items()}
    package = examples.write_files(tmp_path / "p", files)
    assert load_sweep(package, GIVEN).frames.dtype == np.float32


def test_gain_in_lines_of_its_own_as_newer_files_have_it(tmp_path):
    sweep = sweep_of("rf", frames=2)
    rows = [
        f"timestamp: {t}\n" + "".join(f"  - {{ {d:.2f}mm, {g:.2f}dB }}\n" for d, g in curve(last))
        for t, last in zip(examples.frame_times_ns(sweep), (30.0, 50.0), strict=True)
    ]
    text = examples.yml_text(sweep).replace(
        "tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }",
        "tgc:\n  - { 0.00mm, 23.00dB }\n  - { 39.70mm, 35.00dB }",
    )
    files = examples.package_files(sweep, yml=text) | {f"{examples.NAME}_rf.tgc": "".join(rows).encode()}
    package = examples.write_files(tmp_path / "p", files)
    assert load_sweep(package, GIVEN).frames.dtype == np.float32
    assert dict(row[:2] for row in describe(package))["rf: gain"] == "23 dB at 0 mm, 35 dB at 39.7 mm"


@pytest.mark.parametrize("content", [b"", b"# tgc curves per frame\n\nframes: 0\n"])
def test_an_empty_gain_file_tells_nothing(tmp_path, content):
    sweep = sweep_of("rf")
    files = examples.package_files(sweep) | {f"{examples.NAME}_rf.tgc": content}
    package = examples.write_files(tmp_path / "p", files)
    require_equal(load_sweep(package, GIVEN), sweep)
    assert dict(row[:2] for row in describe(package))["gain by frame"] == "not told: taken as the same"


def test_gain_of_other_times_is_named(tmp_path):
    sweep = sweep_of("rf")
    files = examples.package_files(sweep)
    files[f"{examples.NAME}_rf.tgc"] = examples.tgc_text(examples.frame_times_ns(sweep)[1:]).encode()
    with pytest.raises(
        InvalidInputError, match=r"rf\.tgc: expected the gain of the frame at \d+ ns, got none"
    ):
        load_sweep(examples.write_files(tmp_path / "p", files), GIVEN)


def test_region_of_interest_without_data_around_is_cut_out(tmp_path):
    sweep = sweep_of("rf")
    frames = np.zeros_like(sweep.frames)
    frames[:, 1:4, 8:30] = sweep.frames[:, 1:4, 8:30]
    padded = replace(sweep, frames=frames)
    roi = "roi: {start line: 1, end line: 3, start sample: 8, end sample: 29}\n"
    package = examples.write_package(tmp_path / "p", padded, yml=examples.yml_text(padded) + roi)
    found = load_sweep(package, GIVEN)
    np.testing.assert_array_equal(found.frames[2], sweep.frames[2][1:4, 8:30])
    first_mm = sweep.grid.first_sample_depth_mm + 8 * sweep.grid.sample_spacing_mm
    assert found.grid.first_sample_depth_mm == pytest.approx(first_mm, rel=1e-12)
    rows = dict(row[:2] for row in describe(package))
    assert rows["first line at element"].startswith("1.5,")  # 0.3 mm of 0.2 mm elements


def test_data_beyond_the_region_of_interest_is_kept(tmp_path):
    sweep = sweep_of("rf")
    yml = examples.yml_text(sweep) + "roi: {start line: 0, end line: 4, start sample: 0, end sample: 35}\n"
    found = load_sweep(examples.write_package(tmp_path / "p", sweep, yml=yml), GIVEN)
    require_equal(found, sweep)


def test_roi_outside_the_frame_is_named(tmp_path):
    sweep = sweep_of("rf")
    yml = examples.yml_text(sweep) + "roi: {start line: 0, end line: 4, start sample: 0, end sample: 40}\n"
    package = examples.write_package(tmp_path / "p", sweep, yml=yml)
    with pytest.raises(InvalidInputError, match="roi: expected samples from 0 to 39, got 0 to 40"):
        load_sweep(package, GIVEN)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frames: 4", "frames: 5", "header: expected frames 5 as in the yml, got 4"),
        ("number of lines: 5", "number of lines: 6", "lines: expected 6 lines, got 5"),
        ("samples per line: 40", "samples per line: 41", "samples per line 41 as in the yml, got 40"),
        ("sample size: 2 bytes", "sample size: 4 bytes", "expected sample size 4 as in the yml, got 2"),
        ("type: RF", "type: IQ", "expected 4 bytes a sample of type IQ, got 2"),
        ("type: RF", "type: M", "type: expected RF, IQ or B pre-scan, got 'M'"),
        ("compression: none", "compression: jpeg", "compression: expected none, got 'jpeg'"),
        ("40.0 MHz", "40.0", "sampling rate: expected a number of Hz, got '40.0'"),
        ("40.0 MHz", "40.0 mm", "sampling rate: expected a number of Hz, got '40.0 mm'"),
        ("40.0 MHz", "-40.0 MHz", "sampling rate: expected above zero"),
        ("angle: 0 °}\n  - {rx", "angle: 7 °}\n  - {rx", r"lines\[0\]: angle: expected 0 .*got 7 deg"),
        (SECOND, "{rx element: 0.0", r"lines\[1\]: rx element: expected one line a place"),
        (SECOND, "{rx element: 1.9", r"lines\[1\]: rx element: expected evenly spaced lines"),
        ("{ 40.00mm, 26.00dB }", "{ 40.00, 26.00dB }", "expected a gain as"),
        ("type: RF", "type: &a RF", "line 10: expected no anchors and aliases"),
        ("type: RF", "type: [", "expected YAML, got an error"),
        ("type: RF", "type: RF\nprobe: {radius: 45 mm}", "parallel lines, got a curved array of 45 mm"),
    ],
)  # fmt: skip
def test_contradictions_are_named(tmp_path, old, new, message):
    sweep = sweep_of("rf")
    text = examples.yml_text(sweep)
    assert old in text
    package = examples.write_package(tmp_path / "p", sweep, yml=text.replace(old, new, 1))
    with pytest.raises(InvalidInputError, match=message) as caught:
        load_sweep(package, GIVEN)
    assert "\n" not in str(caught.value)
    assert "_rf." in str(caught.value)


def test_lines_given_by_the_first_and_last(tmp_path):
    sweep = sweep_of("rf")
    rows = examples.yml_text(sweep).split("\n")
    first = next(i for i, row in enumerate(rows) if "rx element" in row)
    text = "\n".join(rows[: first + 1] + rows[first + 4 :])
    require_equal(load_sweep(examples.write_package(tmp_path / "p", sweep, yml=text), GIVEN), sweep)


@pytest.mark.parametrize(
    ("probe", "message"),
    [("C3 HD3", "expected parallel lines"), ("L7", "expected a model whose element pitch")],
)
def test_probes_without_a_published_pitch_or_parallel_lines_are_refused(tmp_path, probe, message):
    package = examples.write_package(tmp_path / "p", sweep_of("rf"))
    with pytest.raises(InvalidInputError, match=message):
        load_sweep(package, ImportSettings(probe=probe))


@pytest.mark.parametrize("probe", ["l15hd3", "L15 HD3", "Clarius L15-HD3"])
def test_a_probe_has_one_name_however_it_is_typed(tmp_path, probe):
    package = examples.write_package(tmp_path / "p", sweep_of("rf"))
    found = load_sweep(package, ImportSettings(probe=probe, bandwidth_hz=(4e6, 8e6)))
    assert found.probe == "Clarius L15HD3"
    assert found.grid.vector_pitch_mm == pytest.approx(0.3 / 0.2 * 0.26)


def test_frames_that_the_sensor_does_not_cover_are_told(tmp_path):
    sweep = sweep_of("rf")
    times = examples.bursts_s(sweep.frame_time_s[1], sweep.frame_time_s[2] + 0.06)
    late = replace(sweep, orientation=examples.sensor_of(examples.swayed(times), times))
    rows = dict(row[:2] for row in describe(examples.write_package(tmp_path / "p", late)))
    told = "1 before the sensor's first sample, 1 after its last, 0 in pauses"
    assert rows["frames without orientation"] == told


def test_frame_times_that_do_not_rise_are_named(tmp_path):
    sweep = sweep_of("rf")
    stamps = examples.frame_times_ns(sweep)
    stamps[2] = stamps[1]
    package = examples.write_package(tmp_path / "p", sweep, stamps=stamps)
    with pytest.raises(
        InvalidInputError, match=r"rf\.raw: frame 2: expected a time after \d+ ns, got \d+ ns"
    ):
        load_sweep(package, GIVEN)


@pytest.mark.parametrize("change", [lambda raw: raw[:-1], lambda raw: raw + b"x", lambda raw: raw[:10]])
def test_raw_files_of_another_length_are_named(tmp_path, change):
    files = examples.package_files(sweep_of("rf"))
    name = f"{examples.NAME}_rf.raw"
    package = examples.write_files(tmp_path / "p", files | {name: change(files[name])})
    with pytest.raises(FileError, match=r"rf\.raw: expected"):
        load_sweep(package, GIVEN)


def test_a_package_without_raw_files_is_described(tmp_path):
    files = examples.package_files(sweep_of("rf"))
    files = {name: content for name, content in files.items() if not name.endswith(".raw")}
    package = examples.write_files(tmp_path / "p.tar", files)
    rows = dict(row[:2] for row in describe(package))
    assert rows["rf: frames"] == "4"
    assert rows["rf: raw file"] == "none"
    assert "expected a raw file" in rows["sweep"]
    with pytest.raises(InvalidInputError, match="expected a raw file"):
        load_sweep(package)


def test_a_package_becomes_a_sweep_file(tmp_path):
    sweep = sweep_of("rf")
    package = load_sweep(examples.write_package(tmp_path / "p.tar", sweep, packed=True), GIVEN)
    write_sweep(tmp_path / "sweep.h5", package)
    require_equal(load_sweep(tmp_path / "sweep.h5"), sweep)


@pytest.mark.parametrize("library", ["yaml", "lzallright"])
def test_a_missing_library_is_told_by_its_extra(tmp_path, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    sweep = sweep_of("rf", samples=400)
    sweep.frames[:, :, 20:] = 0  # so that blocks are packed
    package = examples.write_package(tmp_path / "p", sweep, packed=True)
    with pytest.raises(InvalidInputError, match=r'pip install "speckle3d\[clarius\]"'):
        load_sweep(package, GIVEN)


def test_a_sweep_without_a_believed_quaternion_has_no_orientation(tmp_path):
    sweep = sweep_of("rf")
    count = len(sweep.orientation.readings)
    wrong = Rotation.random(count, rng=np.random.default_rng(3)).as_quat()
    text = examples.sensor_text(sweep.orientation, wrong)
    package = examples.write_package(tmp_path / "p", sweep, imu_text=text)
    assert load_sweep(package, GIVEN).orientation is None
    samples, fit = sensor_of(package)
    assert fit is None
    assert len(samples) == count


@pytest.mark.realdata
def test_real_packages(realdata):
    for name, frames in (("carotid", "17"), ("wirephantom", "13")):
        rows = dict(row[:2] for row in describe(realdata / "clarius" / name))
        assert rows["rf: frames"] == frames
        assert rows["quaternion"].startswith("scalar first, world from sensor")
        assert "expected a raw file" in rows["sweep"]
    doppler = realdata / "clarius" / "carotid" / "doppler"
    with pytest.raises(
        InvalidInputError,
        match=r"got 15 deg, and 1248 of 1248 lines steered.*or give another.*carotid_env\.raw",
    ):
        load_sweep(doppler)
    envelope = load_sweep(
        doppler / "carotid_env.raw", ImportSettings(vector_pitch_mm=0.1, dynamic_range_db=60.0)
    )
    assert envelope.frames.shape == (1, 304, 592)
    assert envelope.frames[0].max() == 255
    assert envelope.frame_time_s[0] == pytest.approx(272.547324170, abs=1e-9)
    # 592 samples of 0.0513 mm; the depth is counted from the first but for one of its 16 delay samples.
    assert envelope.grid.depth_mm == pytest.approx(0.051 + 591 * 0.051333, abs=0.01)


@pytest.mark.realdata
def test_real_iq_was_shifted_down_by_its_transmit_frequency(realdata):
    path = realdata / "clarius" / "carotid" / "doppler" / "carotid_iq.raw"
    raw = RawFile(Member(path, path.name, 0, path.stat().st_size))
    header = read_header(raw)
    frame = RawFrames(raw, header, "IQ", slice(None), slice(None))[0]
    assert frame.shape == (1248, 352)
    for part in np.split(frame, 4, axis=1):
        # The mean turn of the phase from sample to sample is the spectrum's centre.
        turn = np.angle(np.vdot(part[:, :-1], part[:, 1:]))
        assert abs(turn * 15.0 / (2 * np.pi)) < 0.01  # MHz


@pytest.mark.parametrize(("shallow", "deep"), [(11, 8), (5, 5)])
def test_demodulation_frequency_is_that_of_the_lines_middle(tmp_path, shallow, deep):
    sweep = sweep_of("iq", samples=400)
    said = f"shallowfreq: {shallow} MHz, deepfreq: {deep} MHz, filterdepth: 40 mm"
    yml = examples.yml_text(sweep).split("focus:")[0] + f"focus:\n  - receive:\n      - {{{said}}}\n"
    package = examples.write_package(tmp_path / "p", sweep, yml=yml)
    middle_mm = sweep.grid.first_sample_depth_mm + 199.5 * sweep.grid.sample_spacing_mm
    found = load_sweep(package, GIVEN).signal.demodulation_frequency_hz
    assert found == pytest.approx(1e6 * (shallow + (deep - shallow) * middle_mm / 40))
    rows = dict(row[:2] for row in describe(package))
    assert rows["demodulation frequency from"].startswith("its yml")


def test_iq_of_older_software_is_asked_for_its_demodulation_frequency(tmp_path):
    sweep = sweep_of("iq")
    package = examples.write_package(tmp_path / "p", sweep, yml=examples.yml_text(sweep).split("focus:")[0])
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(package, GIVEN)
    assert caught.value.settings == ("demodulation_frequency_hz",)
    require_equal(load_sweep(package, GIVEN.model_copy(update={"demodulation_frequency_hz": 6e6})), sweep)


def test_iq_of_a_falling_frequency_becomes_that_of_one(tmp_path):
    """Echoes of 7 MHz, shifted down by 9 to 6 MHz, are afterwards a constant frequency at all depths."""
    rate_hz, samples = 15e6, 600
    depth_mm = np.arange(samples) * 1540e3 / (2 * rate_hz)
    slid = np.interp(depth_mm, [0, 40], [9e6, 6e6])
    phase = 2 * np.pi * (7e6 * np.arange(samples) - np.cumsum(slid) + slid / 2) / rate_hz
    sweep = sweep_of("iq", samples=samples)
    frames = np.tile(np.round(8000 * np.exp(1j * phase)), (len(sweep), 5, 1)).astype(np.complex64)
    sweep = replace(sweep, frames=frames, grid=replace(sweep.grid, first_sample_depth_mm=0.0))
    yml = examples.yml_text(sweep).split("focus:")[0]
    said = "shallowfreq: 9 MHz, deepfreq: 6 MHz, filterdepth: 40 mm"
    yml += f"focus:\n  - receive:\n      - {{{said}}}\n"
    found = load_sweep(examples.write_package(tmp_path / "p.tar", sweep, yml=yml), GIVEN)
    shift_hz = found.signal.demodulation_frequency_hz
    assert shift_hz == pytest.approx(9e6 - 3e6 * depth_mm[-1] / 2 / 40)
    line = found.frames[1][2]
    turn_hz = np.angle(line[1:] * line[:-1].conj()) * rate_hz / (2 * np.pi)
    # Rounding of 8000 to whole numbers: 1e-4 rad, 200 Hz.
    np.testing.assert_allclose(turn_hz + shift_hz, 7e6, atol=1e3)
    assert stored_dtype(found.frames) == np.complex64
    write_sweep(tmp_path / "sweep.h5", found)
    np.testing.assert_array_equal(load_sweep(tmp_path / "sweep.h5").frames[1], found.frames[1])
    assert any("turned" in each for each in import_notes(tmp_path / "p.tar", GIVEN))
