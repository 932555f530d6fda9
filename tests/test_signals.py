"""One sweep as RF and as I/Q: the same lengths, with curves that were measured on RF."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import command

from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.simulation.receiver import received_as_iq

DATA = Path(__file__).resolve().parents[1] / "data"


class Conjugated:
    """I/Q whose Q has the other sign."""

    def __init__(self, frames):
        self.frames, self.shape, self.dtype = frames, frames.shape, frames.dtype

    def __getitem__(self, index):
        return np.conj(self.frames[index])


@pytest.fixture(scope="module")
def rf():
    """The phantom's first 32 frames, 4 mm."""
    return load_sweep(DATA / "phantom.h5").part(0, 32)


def found(sweep, folder):
    """What the command finds, with curves of RF."""
    write_sweep(folder / "sweep.h5", sweep)
    words = ["reconstruct", folder / "sweep.h5", "-o", folder / "out", "--curves", DATA / "curves.h5"]
    done = subprocess.run(
        command(*words, "--reference", "truth", "--json"), capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["sweeps"][0]


@pytest.fixture(scope="module")
def length_of_rf(rf, tmp_path_factory):
    return found(rf, tmp_path_factory.mktemp("rf"))["rows"][0]["estimate_mm"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("middle_hz", "decimation"),
    [(7.5e6, None), (6.5e6, None), (7.5e6, 10)],
    ids=["centre", "off centre", "6.7 MHz for a band of 6"],
)
def test_i_and_q_give_the_lengths_of_their_rf(rf, length_of_rf, tmp_path, middle_hz, decimation):
    row = found(received_as_iq(rf, middle_hz, decimation), tmp_path)["rows"][0]
    # Both signals hold the same echoes; 16 bits and the filters' ends made 0.012 % at most on twelve sweeps.
    assert row["estimate_mm"] == pytest.approx(length_of_rf, rel=2e-3)
    # 1.1 %, the worst of a phantom's sweeps of 20 mm in the documentation, over the root of a fifth of that.
    assert abs(row["length_error_percent"]) < 2.5


@pytest.mark.slow
def test_the_other_sign_of_q_is_told(rf, tmp_path):
    iq = received_as_iq(rf)
    result = found(replace(iq, frames=Conjugated(iq.frames)), tmp_path)
    assert "sign of Q" in json.dumps(result)
