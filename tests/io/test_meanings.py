"""Every data set that we write says its unit and what it holds."""

import h5py
import pytest

from speckle3d.io.meanings import MEANINGS, meaning_of
from speckle3d.simulation.presets import SimulationSettings, simulate


def datasets(path):
    with h5py.File(path) as file:
        held = {}
        file.visititems(
            lambda name, node: (
                held.update({name: dict(node.attrs)}) if isinstance(node, h5py.Dataset) else None
            )
        )
    return held


def test_a_sweeps(tmp_path):
    from speckle3d.io.sweep_writer import write_sweep

    (made,) = simulate(SimulationSettings(vectors=8, samples=600, frames=3))
    write_sweep(tmp_path / "sweep.h5", made.sweep)
    held = datasets(tmp_path / "sweep.h5")
    assert held["tracker/world_from_sensor"]["units"] == "mm"
    assert all({"units", "meaning"} <= set(each) for each in held.values()), held


def test_curves(shipped, tmp_path):
    from speckle3d.io.curves import load_curves, write_curves

    write_curves(tmp_path / "curves.h5", load_curves(shipped / "curves.h5"))
    held = datasets(tmp_path / "curves.h5")
    assert held["distance_mm"]["units"] == "mm"
    assert all({"units", "meaning"} <= set(each) for each in held.values()), held


@pytest.mark.parametrize("name", ["poses/pose", "poses/fused", "pairs/distance_mm", "pose_covariance/image"])
def test_patterns_find_what_a_reconstruction_holds(name):
    assert meaning_of("speckle3d.reconstruction", name) is not None
    assert meaning_of("speckle3d.reconstruction", f"other/{name}") is None


def test_no_meaning_is_empty():
    assert all(meaning for told in MEANINGS.values() for _, meaning in told.values())
