"""A handheld with a sensor inside: the documentation's commands on packages of simulated scans."""

import re
import shlex

import numpy as np
import pytest
from handheld import write_handheld
from scipy.spatial.transform import Rotation

from speckle3d.core.geometry import elevational_steps
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.simulation.presets import SimulationSettings, simulate

ELEMENT_MM = 0.26
"""Of the probe in the documentation."""


def simulated(**settings):
    return simulate(SimulationSettings(signal="iq", **settings))[0]


@pytest.mark.slow
def test_from_unboxing_to_a_volume(run, project, tmp_path, monkeypatch):
    text = (project / "docs" / "howto" / "handheld.md").read_text(encoding="utf-8")
    (commands, _), tables = (
        [shown.replace("$ ", "") for shown in re.findall(r"```console\n(.*?)```", text, re.S)],
        re.findall(r"```toml\n(.*?)```", text, re.S),
    )
    assert len(commands.splitlines()) == 10
    scan = {"preset": "plane", "reflector": "bar", "vectors": 40, "frames": 60, "duration_s": 20.0}
    baths = [simulated(**scan, seed=seed) for seed in (4101, 4102)]
    sweep = simulated(preset="phantom", vectors=26, samples=2000, length_mm=3.0, frames=30, seed=4103)
    for name, made in zip(("bath", "again", "sweep"), (*baths, sweep), strict=True):
        write_handheld(tmp_path / f"{name}.tar", made.sweep, ELEMENT_MM)
    (tmp_path / "import.toml").write_text(tables[0], encoding="utf-8")
    # Simulated baths carry sound as tissue does, so that the second table stays out.
    (tmp_path / "probe.toml").write_text(tables[2], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for line in commands.splitlines():
        program, *arguments = shlex.split(line)
        if program == "speckle3d":
            code, _, err = run(*arguments)
            assert code == 0, (line, err)

    found = read_calibration(tmp_path / "mounting.h5")
    true = Rotation.from_quat(baths[0].description()["orientation_sensor_from_image_wxyz"], scalar_first=True)
    error = np.abs((true.inv() * found.rotation).as_rotvec())
    # Three claimed deviations: one scan in a hundred is farther off.
    assert (error < 3 * np.sqrt(np.diag(found.covariance))[:3]).all(), np.rad2deg(error)

    poses = read_reconstruction(tmp_path / "out" / "reconstruction.h5").poses["image"]
    centre = sweep.sweep.grid.centre_mm
    got, wanted = (abs(elevational_steps(each, centre).sum()) for each in (poses, sweep.sweep.truth))
    # Curves from a data sheet claim 10 % (one deviation); those of this probe's own sheet are nearer.
    assert got == pytest.approx(wanted, rel=0.1)
    back = load_sweep(tmp_path / "sweep.igs.mha")
    assert len(back) == len(sweep.sweep)
    assert back.orientation is not None
    np.testing.assert_array_equal(back.frames[7], sweep.sweep.frames[7])
