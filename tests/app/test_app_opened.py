"""What a file is tells its pages; what has none is one line."""

import numpy as np
import panel
import pytest
from imu_logs import samples

import speckle3d.app
from speckle3d.app.opened import pages_of
from speckle3d.cli import main
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import write_csv


def titles(path, **options):
    return [page.title for page in pages_of(path, **options)]


@pytest.fixture
def log(tmp_path):
    write_csv(tmp_path / "log.csv", ImuLog(**{**samples(300), "source": "turning"}))
    return tmp_path / "log.csv"


def test_a_sweep_with_a_sensor_has_both_pages_and_a_log_its_own(data_folder, log):
    assert titles(data_folder / "phantom.h5") == ["Sweep", "Sensor"]
    assert titles(log) == ["Sensor"]


@pytest.mark.realdata
def test_a_package_without_frames_still_has_its_sensor(realdata):
    (page,) = pages_of(realdata / "clarius" / "wirephantom")
    assert page.title == "Sensor"
    assert any("frames are not shown: " in pane.object for pane in page.view().select(panel.pane.HTML))


def test_what_has_no_page_is_one_line_and_exit_code_2(data_folder, log, tmp_path, capsys, monkeypatch):
    (tmp_path / "empty").write_bytes(b"")
    cases = [
        (data_folder / "curves.h5",), (data_folder,), (tmp_path / "none.h5",), (tmp_path / "empty",),
        (log, "--record", tmp_path / "out.mtb"),
        (data_folder / "phantom.h5", "--reconstruction", data_folder / "phantom.h5"),
    ]  # fmt: skip
    for arguments in cases:
        monkeypatch.setattr("sys.argv", ["speckle3d", "view", "--no-browser", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        lines = capsys.readouterr().err.splitlines()
        assert (end.value.code, len(lines)) == (2, 1), (arguments, lines)
        assert "expected" in lines[0]


def test_a_notebook_shows_the_same_pages(log):
    from bokeh.document import Document

    document = Document()
    page = speckle3d.app.view(log)
    document.add_root(page.get_root(document))
    document.to_json()  # as it is sent to the notebook
    assert len(document.roots) == 1
    (columns,) = (model.data for model in document.models if "heading" in getattr(model, "data", {}))
    assert np.isfinite(columns["dip"]).any()
