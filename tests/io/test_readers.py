"""One door: what a recording lacks comes from options or from a file beside it, and is asked for at once."""

import pytest
from image_examples import frame_fields, grey, write_mha
from PIL import Image

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError, settings_for
from speckle3d.io.load import load_sweep, recording_files, recording_sha256

BMODE = "column_pitch_mm = 0.1\nrow_spacing_mm = 0.2\ndynamic_range_db = 60\n"


@pytest.fixture
def images(tmp_path):
    return write_mha(tmp_path / "a.mha", grey(), frames=frame_fields(3)[2])


def test_a_recordings_own_file_comes_before_the_folders_and_options_before_both(images):
    images.with_name("import.toml").write_text(BMODE)
    assert load_sweep(images).signal == BModeSettings(60.0)
    images.with_name("a.mha.toml").write_text(BMODE.replace("60", "70"))
    assert load_sweep(images).signal == BModeSettings(70.0)
    options = ImportSettings(dynamic_range_db=80.0)
    assert load_sweep(images, options).signal == BModeSettings(80.0)
    assert settings_for(images, options).column_pitch_mm == 0.1


def test_the_hash_of_a_recording_covers_what_stands_beside_it(images):
    alone = recording_sha256(images)
    beside = images.with_name("a.mha.toml")
    beside.write_text(BMODE)
    assert recording_files(images) == [images, beside]
    with_settings = recording_sha256(images)
    beside.write_text(BMODE.replace("60", "70"))
    assert len({alone, with_settings, recording_sha256(images)}) == 3


def test_settings_of_a_folder_stand_beside_it_or_in_it(tmp_path, monkeypatch):
    scan = tmp_path / "scan"
    scan.mkdir()
    for i, image in enumerate(grey()):
        Image.fromarray(image).save(scan / f"{i}.png")
    with pytest.raises(MissingSettingsError, match=r"import\.toml in it: --column-pitch-mm.*--frame-rate-hz"):
        load_sweep(scan)
    (tmp_path / "scan.toml").write_text(f"{BMODE}frame_rate_hz = 10\n")
    assert load_sweep(scan).frame_time_s.tolist() == [0.0, 0.1, 0.2]
    assert recording_files(scan)[-1] == tmp_path / "scan.toml"
    (tmp_path / "scan.toml").rename(scan / "import.toml")
    monkeypatch.chdir(scan)
    assert load_sweep(".").grid.vector_pitch_mm == 0.1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("column_pitch_mm", 300.0, "vector_pitch_mm: .*another unit"),
        ("row_spacing_mm", 0.0002, "sample_spacing_mm"),
        ("frame_rate_hz", 25000.0, "frame_interval_s"),
    ],
)
def test_numbers_in_another_unit_are_errors(tmp_path, name, value, message):
    path = write_mha(tmp_path / "a.mha", grey())
    options = {"column_pitch_mm": 0.1, "row_spacing_mm": 0.2, "dynamic_range_db": 60.0, "frame_rate_hz": 10.0}
    with pytest.raises(InvalidInputError, match=rf"a\.mha: {message}"):
        load_sweep(path, ImportSettings(**options | {name: value}))
