import numpy as np
import pytest
from format_examples import FRAMES, SAMPLES, VECTORS, grey, rf, write_ultrasonix
from sweep_examples import frames_of

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep

RF = ImportSettings(vector_pitch_mm=0.3, bandwidth_hz=(4e6, 9e6))
GREY = ImportSettings(column_pitch_mm=0.2, row_spacing_mm=0.1, dynamic_range_db=60.0)


@pytest.mark.parametrize(("name", "tags"), [("arm.rf", False), ("arm.rf", True), ("arm", False)])
def test_rf_with_and_without_frame_numbers_or_a_suffix(tmp_path, name, tags):
    sweep = load_sweep(write_ultrasonix(tmp_path / name, rf(), tags=tags), RF)
    np.testing.assert_array_equal(frames_of(sweep), rf())
    assert sweep.frames.dtype == np.int16
    assert sweep.signal == RFSettings(40e6, 1540.0, 6.66e6, (4e6, 9e6))
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.3, 1540.0 / 80e3, 0.0)
    np.testing.assert_array_equal(sweep.frame_time_s, np.arange(FRAMES) / 31)


@pytest.mark.parametrize(("suffix", "kind"), [("b8", 4), ("bpr", 2)])
def test_grey_levels_before_and_after_scan_conversion(tmp_path, suffix, kind):
    sweep = load_sweep(write_ultrasonix(tmp_path / f"a.{suffix}", grey(), kind), GREY)
    np.testing.assert_array_equal(frames_of(sweep), grey())
    assert sweep.signal == BModeSettings(60.0)
    assert sweep.grid == ImageGrid(VECTORS, SAMPLES, 0.2, 0.1, 0.0)
