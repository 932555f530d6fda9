"""What the page on formats shows is run as it stands there."""

import importlib
import json
import re
import sys
import tomllib

import numpy as np
import pytest
from format_examples import rf

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import RFSettings
from speckle3d.io import readers
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, recording_files


@pytest.fixture(scope="module")
def page(project):
    return (project / "docs" / "howto" / "formats.md").read_text(encoding="utf-8")


def block(page, language, holding):
    texts = re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)
    (code,) = (text for text in texts if holding in text)
    return code


@pytest.fixture
def package(tmp_path, monkeypatch, page):
    """The page's package, as pip leaves it."""
    place = tmp_path / "site"
    project = tomllib.loads(block(page, "toml", "entry-points"))["project"]
    ((group, entries),) = project["entry-points"].items()
    ((name, target),) = entries.items()
    information = place / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
    module = target.partition(":")[0]
    (place / f"{module}.py").write_text(block(page, "python", "READER = "))
    monkeypatch.syspath_prepend(str(place))
    importlib.invalidate_caches()
    readers.readers.cache_clear()
    yield place
    readers.readers.cache_clear()
    sys.modules.pop(module, None)


def test_a_reader_of_ones_own(tmp_path, package, page):
    header = {"rig": 1, "frames": 4, "vectors": 6, "samples": 40, "rate_hz": 40e6, "transmit_hz": 6e6}
    header |= {"time_s": [0.0, 0.1, 0.2, 0.3], "pitch_mm": 0.3}
    (tmp_path / "arm.json").write_text(json.dumps(header))
    (tmp_path / "arm.bin").write_bytes(rf().tobytes())
    with pytest.raises(MissingSettingsError) as error:
        load_sweep(tmp_path / "arm.json")
    assert error.value.settings == ("bandwidth_hz",)
    sweep = load_sweep(tmp_path / "arm.json", ImportSettings(bandwidth_hz=(4e6, 8e6)))
    np.testing.assert_array_equal(np.stack([sweep.frames[i] for i in range(4)]), rf())
    assert sweep.signal == RFSettings(40e6, 1540.0, 6e6, (4e6, 8e6))
    assert sweep.grid == ImageGrid(6, 40, 0.3, sweep.signal.sample_spacing_mm)
    np.testing.assert_array_equal(sweep.frame_time_s, header["time_s"])
    assert recording_files(tmp_path / "arm.json")[1:] == [tmp_path / "arm.bin"]


def test_every_format_is_in_the_table(page):
    for reader in readers.readers():
        assert re.search(rf"^\| `?{re.escape(reader.format)}`? \|", page, flags=re.MULTILINE), reader.format
