import pytest

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.toml import load_toml


@pytest.mark.parametrize("text", [
    "row_spacing_mm = true", "row_spacing_mm = '0.2'", "row_spacing_mm = inf", "bandwidth_hz = [5e6, false]",
    "image_to_probe = [[true, 0, 0, 0]]", "sampling_rate_hz = 40", "colum_pitch_mm = 0.1",
])  # fmt: skip
def test_slips_are_named_in_one_line(tmp_path, text):
    (tmp_path / "import.toml").write_text(text)
    with pytest.raises(InvalidInputError, match=rf"import\.toml: {text.split()[0]}") as caught:
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
