"""What a package and the options say is checked against each other."""

from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import GIVEN, sweep_of

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.clarius.checks import depth_notes, require_depth
from speckle3d.io.clarius.package import Member
from speckle3d.io.clarius.sidecars import read_description
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import import_notes, load_sweep

BAND = {"bandwidth_hz": (4e6, 8e6)}


def rows_of(path):
    return dict(row[:2] for row in describe(path))


def test_an_element_pitch_is_multiplied_by_the_elements_per_line(tmp_path):
    """Lines of the examples are 0.3 mm apart, of 0.2 mm elements: 1.5 elements."""
    package = examples.write_package(tmp_path / "p", sweep_of("rf"), sensor=False)
    by_element = load_sweep(package, ImportSettings(element_pitch_mm=0.26, **BAND))
    assert by_element.grid.vector_pitch_mm == pytest.approx(1.5 * 0.26)
    by_line = load_sweep(package, ImportSettings(vector_pitch_mm=0.26, **BAND))
    assert by_line.grid.vector_pitch_mm == 0.26
    notes = import_notes(package, ImportSettings(vector_pitch_mm=0.26, **BAND))
    assert any("lines are 1.5 elements apart" in each and "0.1733 mm" in each for each in notes)
    package.with_name("import.toml").write_text("vector_pitch_mm = 0.26\nbandwidth_hz = [4e6, 8e6]\n")
    rows = rows_of(package)
    assert (rows["elements per line"], rows["vector pitch from"]) == ("1.5", "as given")
    assert (rows["element pitch, by it"], rows["width of the image, by it"]) == ("0.1733", "1.04")
    assert rows["array from element 0 to 6, by it"] == "1.04"


@pytest.mark.parametrize(
    ("given", "own", "message"),
    [
        ({"probe": "L15 HD3"}, "0.2 mm", r"got 0.2 mm \(probe: pitch\) and 0.26 mm \(--probe L15 HD3\)"),
        (
            {"probe": "L15 HD3", "vector_pitch_mm": 0.26},
            None,
            r"got 0.1733 mm \(--vector-pitch-mm / 1.5 elem",
        ),
        ({"element_pitch_mm": 0.26, "vector_pitch_mm": 0.26}, None, r"got 0.1733 mm .* and 0.26 mm"),
        ({"probe": "C3 HD3", "element_pitch_mm": 0.3}, "0.3 mm", "expected parallel lines"),
    ],
)
def test_pitches_that_contradict_each_other_are_refused(tmp_path, given, own, message):
    yml = examples.yml_text(sweep_of("rf")) + (f"probe: {{pitch: {own}}}\n" if own else "")
    package = examples.write_package(tmp_path / "p", sweep_of("rf"), yml=yml, sensor=False)
    with pytest.raises(InvalidInputError, match=message):
        load_sweep(package, ImportSettings(**given, **BAND))


def test_a_given_pitch_replaces_the_ymls_and_it_is_said(tmp_path):
    yml = examples.yml_text(sweep_of("rf")) + "probe: {pitch: 0.2 mm}\n"
    package = examples.write_package(tmp_path / "p", sweep_of("rf"), yml=yml, sensor=False)
    given = ImportSettings(element_pitch_mm=0.3, **BAND)
    assert load_sweep(package, given).grid.vector_pitch_mm == pytest.approx(0.45)
    assert "element pitch 0.3 mm as given, 0.2 mm in its yml" in import_notes(package, given)


def test_lines_from_the_highest_element_down_are_named(tmp_path):
    rows = examples.yml_text(sweep_of("rf")).split("\n")
    first = next(i for i, row in enumerate(rows) if "rx element" in row)
    rows[first : first + 5] = rows[first : first + 5][::-1]
    package = examples.write_package(tmp_path / "p", sweep_of("rf"), yml="\n".join(rows), sensor=False)
    with pytest.raises(
        InvalidInputError, match=r"lines\[1\].*expected lines from the lowest element up, got 4.5"
    ):
        load_sweep(package, GIVEN)


BOMB = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frames: 4", f"{BOMB}frames: 4", "line 3: expected no anchors and aliases"),
        ("frames: 4", "frames: [[*x]]", "expected no anchors and aliases, got one"),
        ("frames: 4", "x: !!python/name:os.system y\nframes: 4", "line 3: expected no tags"),
        ("frames: 4", "frames: 0x" + "f" * 9000, "frames: expected a number, got '0xf{38}'...$"),
        ("frames: 4", "frames: " + "9" * 9000, "frames: expected a number, got '9{40}'...$"),
        ("frames: 4", "frames: {a: [" + "x, " * 9000 + "x]}", "frames: expected a number, got fields$"),
        ("frames: 4", "frames: " + "[" * 9000, "at most 16 levels of fields"),
        ("frames: 4", "frames: 4\nframes: 4", "line 4: frames: expected it once, got it twice"),
        ("{samples", "{number of lines: 5, samples", "number of lines: expected it once, got it twice"),
        ("type: RF", "type: {a: {b: RF}}", "type: expected RF, IQ or B pre-scan, got fields$"),
    ],
)
def test_yaml_that_the_scanner_does_not_write_is_refused_in_a_line(tmp_path, old, new, message):
    text = examples.yml_text(sweep_of("rf"))
    assert old in text
    package = examples.write_package(
        tmp_path / "p", sweep_of("rf"), yml=text.replace(old, new, 1), sensor=False
    )
    with pytest.raises(InvalidInputError, match=message) as caught:
        load_sweep(package, GIVEN)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(tmp_path)) + 300


def test_numbers_are_decimal():
    from speckle3d.io.clarius.documents import documents_of

    text = "a: 010\nb: 1:30\nc: ''\nd:\ne: [1, {f: null}]\n---\n---\ng: true\n"
    assert list(documents_of(text, "x")) == [
        {"a": "010", "b": "1:30", "c": "", "d": None, "e": ["1", {"f": None}]},
        {"g": "true"},
    ]


def with_field(kind, field, value, samples=400):
    """A description with another value; samples at 15 or 40 MHz that start at 2 mm or so."""
    sweep = sweep_of(kind, samples=samples)
    rows = examples.yml_text(sweep).split("\n")
    i = next(i for i, row in enumerate(rows) if row.startswith(f"{field}:"))
    rows[i : i + 1] = [] if value is None else [f"{field}: {value}"]
    return sweep, "\n".join(rows)


@pytest.mark.parametrize(
    ("kind", "factor", "message"),
    [
        ("rf", 0.5, r"reach the imaging depth of .* mm, got 400 that reach .*: --sampling-rate-hz replaces"),
        ("iq", 0.5, "reach the imaging depth"),
        ("env", 2.5, "reach the imaging depth"),
        ("rf", 2.5, ""),  # may be cropped to a region of interest
        ("env", 1.3, ""),
        ("env", 1.0, None),
    ],
)
def test_a_sampling_rate_that_the_imaging_depth_contradicts(tmp_path, kind, factor, message):
    sweep = sweep_of(kind, samples=400)
    rate = getattr(sweep.signal, "sampling_rate_hz", 1540e3 / (2 * sweep.grid.sample_spacing_mm)) / 1e6
    # The delay stays the same time.
    delay = factor * rate * (sweep.grid.first_sample_depth_mm * 2e3 / 1540 + 1)
    sweep, yml = with_field(kind, "sampling rate", f"{factor * rate!r} MHz")
    text = "\n".join(f"delay samples: {delay}" if "delay" in row else row for row in yml.split("\n"))
    package = examples.write_package(tmp_path / "p", sweep, yml=text, sensor=False)
    if message:
        with pytest.raises(InvalidInputError, match=message):
            load_sweep(package, GIVEN)
        given = GIVEN.model_copy(update={"sampling_rate_hz": factor * rate * 1e6})
        assert load_sweep(package, given).grid.sample_spacing_mm == pytest.approx(0.77 / rate / factor)
        return
    load_sweep(package, GIVEN)
    told = any("the imaging depth in the yml is" in each for each in import_notes(package, GIVEN))
    assert told == (message == "")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("-5", r"delay samples: expected from 0 to less than .*, got -5 samples"),
        ("9999", r"delay samples: expected from 0 .*, got 9999 samples, which begin at 191.7 mm"),
        (None, "--first-sample-depth-mm"),
        ("0", "--first-sample-depth-mm"),
    ],
)
def test_a_delay_that_cannot_be_is_no_depth(tmp_path, value, message):
    sweep, yml = with_field("rf", "delay samples", value)
    package = examples.write_package(tmp_path / "p", sweep, yml=yml, sensor=False)
    with pytest.raises(InvalidInputError, match=message) as caught:
        load_sweep(package, GIVEN)
    if value in (None, "0"):
        assert caught.value.settings == ("first_sample_depth_mm",)
        assert rows_of(package)["first sample's depth from"].startswith("not said")
    given = GIVEN.model_copy(update={"first_sample_depth_mm": 1.5})
    assert load_sweep(package, given).grid.first_sample_depth_mm == 1.5


def test_a_delay_of_a_microsecond_less_part_of_a_sample_is_depth_0(tmp_path):
    sweep, yml = with_field("rf", "delay samples", "39.5")  # at 40 MHz
    package = examples.write_package(tmp_path / "p", sweep, yml=yml, sensor=False)
    assert load_sweep(package, GIVEN).grid.first_sample_depth_mm == 0.0


@pytest.mark.parametrize(
    ("steps_s", "message"),
    [
        ([0.09] * 9, None),
        ([0.5] * 2 + [0.09] * 7, None),
        ([0.3] * 9, None),  # every third
        ([0.09] * 3 + [61.0] + [0.09] * 5, "frame 4: .* within 60 s of the frame before, got 61 s"),
        ([0.00009] * 9, "frame 1: expected about 0.09091 s .* frame rate of 11 Hz in the yml, got 9e-05 s"),
        ([1.5] * 9, "frame 1: expected about 0.09091 s"),
    ],
)  # fmt: skip
def test_frame_times_that_are_not_of_the_frame_rate_are_named(tmp_path, steps_s, message):
    sweep = replace(sweep_of("rf", frames=10), frame_time_s=10 + np.cumsum([0.0, *steps_s]))
    package = examples.write_package(tmp_path / "p", sweep, sensor=False)
    if message is None:
        load_sweep(package, GIVEN)
        return
    with pytest.raises(InvalidInputError, match=rf"_rf\.raw: {message}"):
        load_sweep(package, GIVEN)


def test_info_measures_the_band_whatever_else_is_missing_and_keeps_its_rows(tmp_path):
    files = examples.package_files(sweep_of("rf")) | {f"{examples.NAME}_rf.tgc": b"timestamp: 5 { 1.00mm }"}
    package = examples.write_files(tmp_path / "p", files)
    unfit = "cannot be told: "
    for probe, told in (("", "not said"), ('probe = "C3"', unfit), ('probe = "X"', unfit)):
        package.with_name("import.toml").write_text(f"{probe}\nbandwidth_hz = [4e6, 8e6]\n")
        rows = rows_of(package)
        assert rows["vector pitch from"].startswith(told)
        assert rows["band from"] == "4.00 to 8.00 MHz, as given"
        assert rows["gain by frame"].startswith("cannot be told: ")
        assert rows["quaternion"].startswith("scalar first")
        assert rows["sweep"].startswith("none: ")


def test_an_accelerometer_in_other_units_is_told(tmp_path):
    sweep = sweep_of("rf")
    package = examples.write_package(tmp_path / "p", sweep)
    assert not any("accelerometer's" in each for each in import_notes(package, GIVEN))
    strong = replace(sweep.orientation, accelerometer_m_s2=9.81 * sweep.orientation.accelerometer_m_s2)
    package = examples.write_package(tmp_path / "q", replace(sweep, orientation=strong))
    told = [each for each in import_notes(package, GIVEN) if "9.81 g, and 1 g is felt at rest" in each]
    assert len(told) == 1
    assert "(in m/s^2?)" in told[0]
    assert [row[1] for row in describe(package)].count(told[0]) == 1


def test_info_measures_the_band_without_a_pitch(tmp_path):
    """Lines of the same noise, which has equal power from 4 to 8 MHz."""
    sweep = sweep_of("rf", samples=1200)
    mhz = np.fft.rfftfreq(1200, 1 / 40)
    spectrum = np.fft.rfft(np.random.default_rng(0).normal(0, 9000, (4, 1, 1200))) * ((mhz > 4) & (mhz < 8))
    echoes = np.round(np.fft.irfft(spectrum) + np.zeros((4, 5, 1))).astype(np.int16)
    package = examples.write_package(tmp_path / "p", replace(sweep, frames=echoes), sensor=False)
    rows = rows_of(package)
    assert rows["vector pitch from"] == "not said"
    low, high = (float(each) for each in rows["band from"].split(" MHz, measured at -6 dB")[0].split(" to "))
    # The resolution is 0.5 MHz.
    assert (low, high) == pytest.approx((4.0, 8.0), abs=0.5)


@pytest.mark.realdata
def test_no_real_description_contradicts_itself(realdata):
    files = [each for each in (realdata / "clarius").rglob("*.yml") if not each.stem.endswith("imu")]
    assert len(files) == 8
    for file in files:
        said = read_description(Member(file, file.name, 0, file.stat().st_size))
        require_depth(file.stem.split("_")[1], said, ImportSettings())
        # Doppler frames lie in a region of interest.
        told = bool(depth_notes(said, ImportSettings()))
        assert told == (file.name == "carotid_iq.yml" and file.parent.name == "doppler"), file


def test_numbers_given_over_the_packages_own_are_told(tmp_path):
    package = examples.write_package(tmp_path / "a", sweep_of("rf"), sensor=False)
    given = GIVEN.model_copy(update={"speed_of_sound_m_s": 1482.0, "centre_frequency_hz": 5e6})
    notes = " ".join(import_notes(package, given))
    assert "centre frequency 5 MHz, given: its yml says" in notes
    assert "speed of sound" not in notes  # assumed, and nothing contradicts
    assert "centre frequency" not in " ".join(import_notes(package, GIVEN))
