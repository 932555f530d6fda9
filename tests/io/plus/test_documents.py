"""Documents of PLUS are told what they are, and which option takes them; they are no sweeps."""

import pytest

from speckle3d.cli.describe import describe
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.load import kind_of, load_sweep


@pytest.mark.parametrize(
    ("content", "expected", "option"),
    [
        (
            '\ufeff<?xml version="1.0"?>\n<!-- x -->\n<ProbeCalibrationResult><CalibrationResults><Transform '
            'From="Image" To="Probe" Matrix="0.1 0 0 1 0 0.2 0 2 0 0 1 3 0 0 0 1"/></CalibrationResults>'
            "</ProbeCalibrationResult>",
            {"content": "the result of a probe calibration", "pixel": "0.10000 mm x 0.20000 mm"},
            "--plus-config",
        ),
        (
            '<TemporalCalibrationResults TrackerLagSec="-0.0648266"/>',
            {"content": "a tracker's delay", "time offset of the tracker": "+0.0648"},
            "--time-offset-s",
        ),
    ],
)
def test_documents_are_told_apart(tmp_path, content, expected, option):
    path = tmp_path / "a.xml"
    path.write_text(content, encoding="utf-8")
    rows = {name: value for name, value, _ in describe(path)}
    assert kind_of(path) == rows["format"] == "PLUS document"
    assert expected.items() <= rows.items()
    assert option in rows["for"]
    with pytest.raises(InvalidInputError, match=rf"a\.xml: expected a recording, got .*{option}") as error:
        load_sweep(path)
    assert rows["sweep"] == f"none: {error.value}"
