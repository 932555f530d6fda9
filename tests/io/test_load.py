import json

import numpy as np
import sweep_examples
from image_examples import frame_fields, grey, write_mha

from speckle3d.cli.describe import describe
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import import_record, load_sweep, open_recording

BMODE = ImportSettings(column_pitch_mm=0.1, row_spacing_mm=0.2, dynamic_range_db=60.0)


def values(path):
    return {name: (value, unit) for name, value, unit in describe(path)}


def test_the_reader_is_chosen_by_content_not_by_name(tmp_path):
    write_sweep(tmp_path / "sweep.mha", sweep_examples.rf_sweep())
    write_mha(tmp_path / "images.h5", grey(), frames=frame_fields(3)[2])
    assert len(load_sweep(tmp_path / "sweep.mha")) == 6
    assert len(load_sweep(tmp_path / "images.h5", BMODE)) == 3


def test_what_settings_override_is_told_with_what_the_file_says(tmp_path):
    pixels = np.zeros((3, 4, 30), np.int16)
    fields = {"UltrasoundImageType": "RF_REAL"}
    path = write_mha(tmp_path / "a.mha", pixels, fields, frame_fields(3)[2], spacing="0.01925 0.2 1")
    (tmp_path / "import.toml").write_text(
        "sampling_rate_hz = 80e6\ncentre_frequency_hz = 5e6\n"
        "bandwidth_hz = [3e6, 7e6]\nvector_pitch_mm = 0.2005"
    )
    rows = values(path)
    assert rows["sampling rate"][0] == "80"
    notes = open_recording(path).notes
    assert notes[0].startswith("sampling rate 80 MHz, given by import.toml: the file says 40 (of samples")
    assert not any("vector pitch" in note for note in notes)  # 0.2005 is within 1 %
    option = ImportSettings(vector_pitch_mm=0.05)
    assert (
        "vector pitch 0.05 mm, given: the file says 0.2 (ElementSpacing)"
        in open_recording(path, option).notes
    )
    settings = ImportSettings(frame_rate_hz=20.0)
    assert "frame rate 20 Hz, given: the file says 10 (of its times)" in open_recording(path, settings).notes


def test_settings_that_were_in_force_are_told_and_a_sweep_file_has_none(tmp_path):
    recording = write_mha(tmp_path / "a.mha", grey())
    assert import_record(recording) is None
    (tmp_path / "import.toml").write_text("dynamic_range_db = 50\nbandwidth_hz = [3e6, 7e6]")
    record = import_record(recording)
    assert record.name == "import.toml"
    assert json.loads(record.settings_json) == {"dynamic_range_db": 50, "bandwidth_hz": [3e6, 7e6]}
    write_sweep(tmp_path / "s.h5", sweep_examples.bmode_sweep())
    assert import_record(tmp_path / "s.h5") is None
