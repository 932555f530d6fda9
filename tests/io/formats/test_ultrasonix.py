import struct

import numpy as np
import pytest
from format_examples import FRAMES, SAMPLES, VECTORS, grey, rf, write_ultrasonix

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings
from speckle3d.io.describe import describe
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep

RF = ImportSettings(vector_pitch_mm=0.3, bandwidth_hz=(4e6, 9e6))
GREY = ImportSettings(column_pitch_mm=0.2, row_spacing_mm=0.1, dynamic_range_db=60.0)


def read(sweep):
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


@pytest.mark.parametrize(("name", "tags"), [("arm.rf", False), ("arm.rf", True), ("arm", False)])
def test_rf_with_and_without_frame_numbers_or_a_suffix(tmp_path, name, tags):
    sweep = load_sweep(write_ultrasonix(tmp_path / name, rf(), tags=tags), RF)
    np.testing.assert_array_equal(read(sweep), rf())
    assert sweep.frames.dtype == np.int16
    assert sweep.signal == RFSettings(40e6, 1540.0, 6.66e6, (4e6, 9e6))
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.3, 1540.0 / 80e3, 0.0)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(FRAMES) / 31)


@pytest.mark.parametrize(("suffix", "kind"), [("b8", 4), ("bpr", 2)])
def test_grey_levels_before_and_after_scan_conversion(tmp_path, suffix, kind):
    sweep = load_sweep(write_ultrasonix(tmp_path / f"a.{suffix}", grey(), kind), GREY)
    np.testing.assert_array_equal(read(sweep), grey())
    assert sweep.signal == BModeSettings(60.0)
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.2, 0.1, 0.0)


def test_what_the_header_lacks_is_asked_for_at_once(tmp_path):
    path = write_ultrasonix(tmp_path / "a.rf", rf(), rate=0, transmit_hz=0)
    with pytest.raises(MissingSettingsError) as caught:
        load_sweep(path)
    missing = ("vector_pitch_mm", "centre_frequency_hz", "bandwidth_hz", "frame_rate_hz")
    assert caught.value.settings == missing
    assert ("recorded", "RF (.rf)", "") in describe(path)
    with pytest.raises(InvalidInputError, match="centre_frequency_hz: expected one near the band"):
        load_sweep(write_ultrasonix(path, rf()), RF.model_copy(update={"bandwidth_hz": (12e6, 15e6)}))


def header(content, **changes):
    names = ("kind", "frames", "width", "height", "bits")
    values = list(struct.unpack_from("<19i", content))
    for name, value in changes.items():
        values[names.index(name)] = value
    return struct.pack("<19i", *values) + content[76:]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c[:-7], "ends early: 3 of 4 frames"),
        (lambda c: c + b"\0" * 7, "expected 1996 bytes"),
        (lambda c: header(c[:76], frames=0), "expected frames"),
        (lambda c: header(c, kind=1024), "type 1024"),
        (lambda c: header(c, bits=8), "8 bits"),
        (lambda c: header(c, frames=10**6, width=2**16, height=2**16), "ends early"),
        (lambda c: header(c, width=0), "expected a recording"),
        (lambda c: c[:60], "expected a recording"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, change, said):
    path = write_ultrasonix(tmp_path / "a.rf", rf())
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(Speckle3DError, match=said) as caught:
        load_sweep(path, RF)
    assert "\n" not in str(caught.value)
    if isinstance(caught.value, InvalidInputError) and "a recording" not in said:
        assert describe(path)[-1][0] == "sweep"
