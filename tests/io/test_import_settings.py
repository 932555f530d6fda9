import pytest
from pydantic import ValidationError

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.toml import load_toml


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("row_spacing_mm = true", r"row_spacing_mm: expected a number, got True"),
        ("row_spacing_mm = '0.2'", r"row_spacing_mm: expected a number, got '0.2'"),
        ("row_spacing_mm = inf", r"row_spacing_mm: expected a finite number, got inf"),
        ("image_to_probe = [[true, 0, 0, 0]]", r"image_to_probe: expected numbers"),
        ("bandwidth_hz = [5, 10]", r"bandwidth_hz: expected it in Hz \(is this in MHz.*got \[5, 10\]"),
        ("bandwidth_hz = [5e6, false]", r"bandwidth_hz: expected numbers"),
        ("sampling_rate_hz = 40", r"sampling_rate_hz: expected it in Hz"),
        ("centre_frequency_hz = 5000", r"centre_frequency_hz: expected it in Hz .*kHz"),
        ("demodulation_frequency_hz = 5", r"demodulation_frequency_hz: expected it in Hz"),
        ("colum_pitch_mm = 0.1", r"colum_pitch_mm: no such setting, expected column_pitch_mm"),
        ("zzz = 1", r"zzz: no such setting, expected one of sampling_rate_hz, .*, arrays"),
    ],
)
def test_slips_are_named_in_one_line(tmp_path, text, message):
    (tmp_path / "import.toml").write_text(text)
    with pytest.raises(InvalidInputError, match=rf"import\.toml: {message}") as caught:
        load_toml(ImportSettings, tmp_path / "import.toml")
    assert "\n" not in str(caught.value)


def test_whole_numbers_and_what_is_low_by_right_are_taken(tmp_path):
    (tmp_path / "import.toml").write_text(
        "row_spacing_mm = 1\nbandwidth_hz = [5_000_000, 10e6]\ndemodulation_frequency_hz = 0\n"
        "frame_rate_hz = 20\nspeed_of_sound_m_s = 1480\nfirst_sample_depth_mm = -1"
    )
    found = load_toml(ImportSettings, tmp_path / "import.toml")
    assert found.bandwidth_hz == (5e6, 10e6)
    assert (found.row_spacing_mm, found.demodulation_frequency_hz, found.frame_rate_hz) == (1.0, 0.0, 20.0)
    with pytest.raises(ValidationError, match="no such setting"):
        ImportSettings(row_spacing=1.0)
