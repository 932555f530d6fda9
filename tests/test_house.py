"""What holds for the whole project: cheap imports, public names, flags of kernels, a page's example."""

import importlib
import json
import re
import tomllib

import pytest
from imu_logs import samples

import speckle3d
import xsens
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import write_csv

HEAVY = ("numba", "llvmlite", "h5py", "numpy", "scipy", "SimpleITK", "matplotlib", "pydantic")


def loaded_after(python, code, names):
    return json.loads(
        python(f"{code}\nimport sys, json; print(json.dumps(sorted(set({names!r}) & set(sys.modules))))")
    )


@pytest.mark.parametrize(
    "code", ["import speckle3d", "import speckle3d; dir(speckle3d); speckle3d.__all__", "import xsens"]
)
def test_importing_a_package_loads_nothing_heavy(python, code):
    assert loaded_after(python, code, HEAVY) == []


def test_the_errors_load_nothing_heavy_and_the_core_only_numpy_and_scipy(python):
    assert loaded_after(python, "from speckle3d import Speckle3DError", HEAVY) == []
    modules = loaded_after(python, "from speckle3d import Sweep", HEAVY)
    assert set(modules) <= {"numpy", "scipy"}


def test_every_module_of_the_sensor_package_stays_clear_of_numba_and_h5py(python, project):
    names = [
        ".".join(path.relative_to(project).with_suffix("").parts)
        for path in (project / "xsens").rglob("[a-z]*.py")
        # The filters, loaded when they run.
        if path.name not in {"heading.py", "online.py", "engines.py"}
    ]
    code = "\n".join(f"import {name}" for name in ["xsens", *names])
    assert loaded_after(python, code, ("numba", "h5py")) == []


def test_the_version_is_the_distributions_and_a_misspelt_name_an_attribute_error():
    assert speckle3d.__version__ == importlib.metadata.version("speckle3d")
    for package in (speckle3d, xsens):
        with pytest.raises(AttributeError, match="trak"):
            _ = package.trak


def test_the_version_stands_in_one_place(project):
    citation = re.search(
        r"^version: (\S+)$", (project / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    settings = tomllib.loads((project / "pyproject.toml").read_text(encoding="utf-8"))
    assert citation[1] == settings["project"]["version"]


def test_every_kernel_says_how_it_is_rounded_and_is_kept(project):
    """A kernel without flags inherits those of whichever kernel calls it first; that copy is then on disk.

    One function compiled with two sets of flags must not be kept: both would have the same place.
    """
    uses = []
    for path in (project / "speckle3d" / "kernels").rglob("*.py"):
        text = re.sub("import (njit|register_jitable)", "", path.read_text(encoding="utf-8"))
        uses += re.findall(r"\b(njit|register_jitable)(?:\(([^)]*)\)(\(?)|\n)", text)
    assert len(uses) > 60
    assert [words for _, words, _ in uses if "fastmath" not in words] == []
    # Called at once, it compiles a function a second time.
    assert [
        words for kind, words, call in uses if kind == "njit" and ("cache=True" in words) == bool(call)
    ] == []


def test_the_example_of_the_orientation_sensor_runs(project, monkeypatch, tmp_path, capsys):
    page = (project / "docs" / "howto" / "orientation.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    write_csv(tmp_path / "log.bin", ImuLog(**{**samples(300), "source": "turning"}))
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "orientation.md", "exec"), {})
    # As many orientations as samples; level and pointing north.
    assert capsys.readouterr().out.startswith("300 [")
