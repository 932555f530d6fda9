"""The command `simulate`: a sweep, or the scan of a phantom, with truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import app, from_options
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.simulation.settings import SimulatedSweep

_MOVING = {"rich_help_panel": "Movement and noise"}
_SCANNING = {"rich_help_panel": "Scans for calibration"}
_STORING = {"rich_help_panel": "What is stored"}

_PRESETS = (
    "phantom, tissue: one way over speckle or layers. reversal: tissue, forward and back. rotation: phantom, "
    "with a deliberate turn. crossed: tissue, two sweeps. stepped: exact steps, for curves. plane, wires: "
    "scans of a phantom in water, for calibration."
)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Sweep file to write; or -o OUT.")],
    preset: Annotated[str, typer.Option(help=_PRESETS)] = "phantom",
    seed: Annotated[int, typer.Option(help="Same seed and settings, same sweep.")] = 0,
    length_mm: Annotated[float | None, typer.Option(help="Length of the sweep, mm (20).")] = None,
    frames: Annotated[
        int | None, typer.Option(help="Frames; by default eight per mm, and 150 of plane and wires.")
    ] = None,
    vectors: Annotated[int | None, typer.Option(help="Vectors in a frame (127).")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples in a vector (3818).")] = None,
    uncalibrated: Annotated[
        bool | None,
        typer.Option("--uncalibrated", help="Do not say how the sensors are mounted: a calibration will."),
    ] = None,
    mounting: Annotated[
        str | None,
        typer.Option(
            help="How the tracker is mounted: bench, the same in all presets, or published, as in Prager et "
            "al. 1997 (bench)."
        ),
    ] = None,
    turn_deg: Annotated[
        float | None, typer.Option(help="rotation: the deliberate turn, degrees (5).", **_MOVING)
    ] = None,
    turn_axis: Annotated[str | None, typer.Option(help="rotation: tilt or yaw (tilt).", **_MOVING)] = None,
    reverse: Annotated[bool | None, typer.Option("--reverse", help="rotation: come back.", **_MOVING)] = None,
    crossing_deg: Annotated[
        float | None, typer.Option(help="crossed: angle of the sweeps, degrees (90).", **_MOVING)
    ] = None,
    fan_deg: Annotated[
        float | None,
        typer.Option(help="crossed: tilt within each sweep, degrees (0).", **_MOVING),
    ] = None,
    drift_mm: Annotated[
        float | None, typer.Option(help="Slow lateral and axial wander, mm (0.5).", **_MOVING)
    ] = None,
    wobble_mm: Annotated[
        float | None,
        typer.Option(help="Deliberate to and fro along the sweep, mm (0).", **_MOVING),
    ] = None,
    wobble_hz: Annotated[float | None, typer.Option(help="Its frequency, Hz (3).", **_MOVING)] = None,
    tremor_mm: Annotated[
        float | None, typer.Option(help="Tremor of the hand in each axis, mm (0.012).", **_MOVING)
    ] = None,
    snr_db: Annotated[
        float | None, typer.Option(help="Speckle over electronic noise, dB (40).", **_MOVING)
    ] = None,
    steps: Annotated[int | None, typer.Option(help="stepped: frames in a block (41).", **_SCANNING)] = None,
    step_mm: Annotated[
        float | None, typer.Option(help="stepped: distance between them, mm (0.05).", **_SCANNING)
    ] = None,
    blocks: Annotated[int | None, typer.Option(help="stepped: independent blocks (4).", **_SCANNING)] = None,
    reflector: Annotated[
        str | None,
        typer.Option(help="plane: wall, or bar, the Cambridge phantom (wall).", **_SCANNING),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(help="plane, wires: how long the scan lasts, s (30).", **_SCANNING),
    ] = None,
    tilt_range_deg: Annotated[
        float | None,
        typer.Option(help="plane, wires: tilt, either way, degrees (25).", **_SCANNING),
    ] = None,
    roll_range_deg: Annotated[
        float | None,
        typer.Option(help="plane, wires: roll, either way, degrees (11).", **_SCANNING),
    ] = None,
    yaw_range_deg: Annotated[
        float | None,
        typer.Option(help="plane, wires: yaw, either way, degrees (90).", **_SCANNING),
    ] = None,
    depth_range_mm: Annotated[
        tuple[float, float] | None,
        typer.Option(help="plane, wires: depths of floor or crossing, mm (12 34).", **_SCANNING),
    ] = None,
    floor_slope_deg: Annotated[
        float | None, typer.Option(help="plane: slope of the floor, degrees (0).", **_SCANNING)
    ] = None,
    sensor_noise: Annotated[
        float | None,
        typer.Option(help="plane, wires: factor on the noise of both sensors (1).", **_SCANNING),
    ] = None,
    signal: Annotated[str | None, typer.Option(help="rf, iq or bmode (rf).", **_STORING)] = None,
    demodulation_frequency_hz: Annotated[
        float | None,
        typer.Option(
            help="iq: what the echoes are shifted down by, Hz (their centre frequency).",
            **_STORING,
        ),
    ] = None,
    decimation: Annotated[
        int | None,
        typer.Option(help="iq, bmode: samples of the echoes in one that is stored.", **_STORING),
    ] = None,
    dynamic_range_db: Annotated[
        float | None,
        typer.Option(help="bmode: from black to white, 8 bits, dB (60).", **_STORING),
    ] = None,
) -> None:
    """Simulate a sweep with truth; `crossed` writes a second file beside the first, named ...-crossing."""
    from speckle3d.io.fileset import FileSet
    from speckle3d.simulation.presets import SimulationSettings
    from speckle3d.simulation.presets import simulate as prepare

    settings = from_options(SimulationSettings, locals())
    with progress_bar("computing the beam"):
        prepared = prepare(settings)
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
