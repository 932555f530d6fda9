import pytest

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.toml import load_toml


@pytest.mark.parametrize("text", [
    "row_spacing_mm = true", "row_spacing_mm = '0.2'", "row_spacing_mm = inf", "bandwidth_hz = [5e6, false]",
    "demodulation_frequency_hz = 5", "sampling_rate_hz = 40", "colum_pitch_mm = 0.1",
])  # fmt: skip
def test_slips_are_named_in_one_line(tmp_path, text):
    (tmp_path / "import.toml").write_text(text)
    with pytest.raises(InvalidInputError, match=rf"import\.toml: {text.split()[0]}") as error:
        load_toml(ImportSettings, tmp_path / "import.toml")
    assert "\n" not in str(error.value)
