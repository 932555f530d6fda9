import struct

import numpy as np
import pytest
from format_examples import FRAMES, SAMPLES, VECTORS, grey, rf, write_ultrasonix

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep

RF = ImportSettings(vector_pitch_mm=0.3, bandwidth_hz=(4e6, 9e6))
GREY = ImportSettings(column_pitch_mm=0.2, row_spacing_mm=0.1, dynamic_range_db=60.0)


def same(sweep, frames):
    return len(sweep) == len(frames) and all(
        np.array_equal(sweep.frames[i], frames[i]) for i in range(len(frames))
    )


@pytest.mark.parametrize("tags", [False, True])
def test_rf_with_and_without_frame_numbers(tmp_path, tags):
    sweep = load_sweep(write_ultrasonix(tmp_path / "arm.rf", rf(), tags=tags), RF)
    assert same(sweep, rf())
    assert sweep.frames.dtype == np.int16
    assert sweep.signal == RFSettings(40e6, 1540.0, 6.66e6, (4e6, 9e6))
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.3, 1540.0 / 80e3, 0.0)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(FRAMES) / 31)
    assert sweep.name == "arm"


@pytest.mark.parametrize(("suffix", "kind"), [("b8", 4), ("bpr", 2)])
def test_grey_levels_before_and_after_scan_conversion(tmp_path, suffix, kind):
    sweep = load_sweep(write_ultrasonix(tmp_path / f"a.{suffix}", grey(), kind), GREY)
    assert same(sweep, grey())
    assert sweep.signal == BModeSettings(60.0)
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.2, 0.1, 0.0)


def test_the_file_is_told_by_its_content_where_the_suffix_says_nothing(tmp_path):
    assert same(load_sweep(write_ultrasonix(tmp_path / "recording", rf()), RF), rf())
    (tmp_path / "text").write_text("nothing of the kind\n" * 20)
    with pytest.raises(InvalidInputError, match="expected a recording"):
        load_sweep(tmp_path / "text")


def test_what_the_header_lacks_is_asked_for_at_once(tmp_path):
    path = write_ultrasonix(tmp_path / "a.rf", rf(), rate=0, transmit_hz=0)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    missing = ("vector_pitch_mm", "centre_frequency_hz", "bandwidth_hz", "frame_rate_hz")
    assert caught.value.settings == missing
    assert ("recorded", "RF (.rf)", "") in describe(path)


def header(content, **changes):
    names = ("kind", "frames", "width", "height", "bits")
    values = list(struct.unpack_from("<19i", content))
    for name, value in changes.items():
        values[names.index(name)] = value
    return struct.pack("<19i", *values) + content[76:]


TAMPERED = {
    "truncated": (lambda c: c[:-7], "ends early: 3 of 4 frames"),
    "longer": (lambda c: c + b"\0" * 7, "expected 1996 bytes"),
    "no frames": (lambda c: header(c[:76], frames=0), "expected frames, got none"),
    "colour Doppler": (lambda c: header(c, kind=1024), r"got colour Doppler \(.col\)"),
    "of 8 bits": (lambda c: header(c, bits=8), "expected samples of 16 bits"),
    "absurd": (lambda c: header(c, frames=10**6, width=2**16, height=2**16), "ends early"),
    "no width": (lambda c: header(c, width=0), "expected a recording"),
    "cut header": (lambda c: c[:60], "expected a recording"),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, name):
    path = write_ultrasonix(tmp_path / "a.rf", rf())
    change, said = TAMPERED[name]
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(Speckle3DError, match=said) as caught:
        load_sweep(path, RF)
    assert "\n" not in str(caught.value)
    if name in ("no frames", "colour Doppler", "of 8 bits"):
        assert describe(path)[-1][0] == "sweep"


def test_a_file_cut_while_it_is_read_is_an_error(tmp_path):
    path = write_ultrasonix(tmp_path / "a.rf", rf())
    sweep = load_sweep(path, RF)
    path.write_bytes(path.read_bytes()[:-100])
    assert np.array_equal(sweep.frames[0], rf()[0])
    with pytest.raises(FileError, match="frame 3: expected 480 bytes, got 380: truncated"):
        sweep.frames[3]
