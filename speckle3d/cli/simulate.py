"""The command `simulate`: a sweep, or the scan of a phantom, with truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from speckle3d.cli.commands import Fields
from speckle3d.cli.common import OutArgument, from_options
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.simulation.presets import SimulatedSweep


def simulate(
    out: OutArgument,
    settings: Annotated[dict[str, Any], Fields("speckle3d.simulation.settings:SimulationSettings")],
) -> None:
    """Simulate a sweep with truth; `crossed` writes a second file beside the first, named ...-crossing.

    Parameters
    ----------
    out
        Sweep file to write; or -o OUT.
    preset, seed, length_mm, vectors, uncalibrated, signal

    Examples
    --------
    $ speckle3d simulate sweep.h5 --preset tissue --length-mm 8 --seed 4
    """
    from speckle3d.io.fileset import FileSet
    from speckle3d.simulation.presets import SimulationSettings
    from speckle3d.simulation.presets import simulate as prepare

    checked = from_options(SimulationSettings, settings)
    with progress_bar("computing the beam"):
        prepared = prepare(checked)
    paths = [out, out.with_name(f"{out.stem}-crossing{out.suffix}")][: len(prepared)]
    for path in paths:
        require_own_place(path, "simulation")
    if len(paths) == 1:
        _write(out, prepared[0])
        return
    # A pair is replaced together: two sweeps of different simulations do not cross.
    with FileSet(out.name, (paths[1].name,)).replaced(out.parent) as part:
        for path, simulated in zip(paths, prepared, strict=True):
            _write(part / path.name, simulated)


def _write(path: Path, simulated: SimulatedSweep) -> None:
    from speckle3d.io.sweep_writer import write_sweep

    with progress_bar(f"simulating {path.name}") as progress:
        write_sweep(path, simulated.sweep, progress, simulation=simulated.description())
