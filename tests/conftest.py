import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

# As the command line does, and before NumPy is loaded: a team of threads slows small factorisations down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings
from made_once import made_once

# The same examples in every run, however busy the machine.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")

# Started in the background or by nohup, a process ignores these, and so would all that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def realdata():
    """Folder of third-party recordings, beside the project."""
    folder = ROOT.parent / "shared" / "realdata"
    if not folder.is_dir():
        pytest.skip(f"needs third-party recordings in {folder}")
    return folder


@pytest.fixture(scope="session")
def project():
    """The project's folder."""
    return ROOT


@pytest.fixture(scope="session")
def data_folder():
    """Folder of the sweep and the curves that come with the project."""
    return ROOT / "data"


@pytest.fixture(scope="session")
def back(tmp_path_factory):
    """File of simulated tissue passed forward and back at 10 mm/s, 25 frames/s; nothing may change it."""
    from speckle3d.io.family.sweep_writer import write_sweep
    from speckle3d.simulation.presets import SimulationSettings, simulate

    settings = SimulationSettings(
        preset="reversal", vectors=26, samples=1200, seed=77, length_mm=10.0, frames=50
    )
    folder = made_once(
        tmp_path_factory,
        "back",
        lambda folder: write_sweep(folder / "back.h5", simulate(settings)[0].sweep),
    )
    return folder / "back.h5"


@pytest.fixture(scope="session")
def small_sweeps(tmp_path_factory, data_folder):
    """Folder of s5.h5 and s6.h5, simulated tissue of 24 frames, and the curves for them."""
    from speckle3d.io.family.sweep_writer import write_sweep
    from speckle3d.simulation.presets import SimulationSettings, simulate

    def make(folder):
        shutil.copy(data_folder / "curves.h5", folder)
        for seed in (5, 6):
            settings = SimulationSettings(
                preset="tissue", vectors=26, samples=1000, seed=seed, length_mm=3.0, frames=24
            )
            write_sweep(folder / f"s{seed}.h5", simulate(settings)[0].sweep)

    return made_once(tmp_path_factory, "small-sweeps", make)


@pytest.fixture(scope="session")
def report_study(tmp_path_factory, small_sweeps):
    """A small study with its report."""
    from report_examples import small_study

    from speckle3d.report.page import write_report

    study = small_study(tmp_path_factory.mktemp("report-study"), small_sweeps)
    write_report(study)
    return study


@pytest.fixture
def many_threads(monkeypatch):
    """Five threads, more than these machines have: slices end in other places, their order is any."""
    from speckle3d.core import threads

    threads.end_threads()
    monkeypatch.setattr(threads, "processors", lambda: 5)
    yield
    threads.end_threads()


@pytest.fixture(scope="session")
def python():
    """Run a few lines in a fresh interpreter and return what it prints."""

    def run(code):
        process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
        assert process.returncode == 0, process.stderr
        return process.stdout

    return run


@pytest.fixture(scope="session")
def sweep(data_folder):
    """The sweep that comes with the project: 96 frames, 12 mm, with both sensors and the truth."""
    from speckle3d.io.load import load_sweep

    return load_sweep(data_folder / "phantom.h5")


@pytest.fixture(scope="session")
def curves(data_folder):
    """The curves that come with the project."""
    from speckle3d.io.family.curves import read_curves

    return read_curves(data_folder / "curves.h5")


@pytest.fixture(scope="session")
def tracking(sweep, curves):
    """The shipped sweep, tracked as it comes."""
    from speckle3d.tracking import track

    return track(sweep, curves)
