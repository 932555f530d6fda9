"""Commands about files: what one holds, the configuration, conversion, simulation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import Json, app, emit, progress_bar
from speckle3d.core.errors import InvalidInputError


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A file the package reads.")], as_json: Json = False
) -> None:
    """Tell what a file holds, after checking it."""
    from speckle3d.io.load import describe

    rows = describe(path)
    if as_json:
        emit(json.dumps([{"description": d, "value": v, "unit": u} for d, v, u in rows], indent=2))
        return
    width = max(len(d) for d, _, _ in rows)
    for description, value, unit in rows:
        emit(f"{description.ljust(width)}  {value} {unit}".rstrip())


@app.command()
def config() -> None:
    """Print the default configuration as TOML."""
    from speckle3d.config import Config

    emit(Config().to_toml())


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Sweep file to write.")],
    preset: Annotated[
        str, typer.Option(help="phantom, tissue, reversal, rotation, crossed or stepped.")
    ] = "phantom",
    seed: Annotated[int, typer.Option(help="Same seed and settings, same sweep.")] = 0,
    vectors: Annotated[int | None, typer.Option(help="Vectors in a frame (127).")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples in a vector (3818).")] = None,
    length_mm: Annotated[float | None, typer.Option(help="Length of the sweep (20).")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames; by default eight per mm.")] = None,
    steps: Annotated[int | None, typer.Option(help="stepped: frames in a block.")] = None,
    step_mm: Annotated[float | None, typer.Option(help="stepped: distance between them.")] = None,
    blocks: Annotated[int | None, typer.Option(help="stepped: independent blocks.")] = None,
    turn_deg: Annotated[float | None, typer.Option(help="rotation: the deliberate turn.")] = None,
    turn_axis: Annotated[str | None, typer.Option(help="rotation: tilt or yaw.")] = None,
    drift_mm: Annotated[float | None, typer.Option(help="Slow lateral and axial wander (0.5).")] = None,
    snr_db: Annotated[float | None, typer.Option(help="Speckle over electronic noise (40).")] = None,
) -> None:
    """Simulate a sweep with truth; `crossed` writes a second file beside the first, named ...-crossing."""
    from pydantic import ValidationError

    from speckle3d.io.sweep_writer import write_sweep
    from speckle3d.simulation.presets import SimulationSettings
    from speckle3d.simulation.presets import simulate as prepare

    given = {k: v for k, v in locals().items() if k in SimulationSettings.model_fields and v is not None}
    try:
        settings = SimulationSettings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise InvalidInputError(
            f"--{name.replace('_', '-')}: {first['msg']}, got {first['input']!r}"
        ) from None
    for number, simulated in enumerate(prepare(settings)):
        path = out if number == 0 else out.with_name(f"{out.stem}-crossing{out.suffix}")
        with progress_bar(f"simulating {path.name}") as progress:
            write_sweep(path, simulated.sweep, progress, simulation=settings.model_dump(mode="json"))


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="MetaImage, NRRD sequence or sweep file.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Sweep file to write.")],
    sampling_rate_hz: Annotated[float | None, typer.Option(help="RF sampling rate.")] = None,
    vector_pitch_mm: Annotated[float | None, typer.Option(help="Distance between vectors.")] = None,
    centre_frequency_hz: Annotated[float | None, typer.Option(help="RF centre frequency.")] = None,
    bandwidth_hz: Annotated[tuple[float, float] | None, typer.Option(help="RF band, low and high.")] = None,
    column_pitch_mm: Annotated[float | None, typer.Option(help="B-mode: distance between columns.")] = None,
    row_spacing_mm: Annotated[float | None, typer.Option(help="B-mode: distance between rows.")] = None,
    dynamic_range_db: Annotated[float | None, typer.Option(help="B-mode: dynamic range.")] = None,
    frame_rate_hz: Annotated[float | None, typer.Option(help="For sequences without time stamps.")] = None,
) -> None:
    """Turn an image sequence into a sweep file; options give what its header lacks."""
    from speckle3d.io.load import load_sweep
    from speckle3d.io.metaimage import ImportSettings
    from speckle3d.io.sweep_writer import write_sweep

    names = ImportSettings.__dataclass_fields__
    given = {k: v for k, v in locals().items() if k in names and v is not None}
    sweep = load_sweep(source, ImportSettings(**given))
    with progress_bar(f"writing {out.name}") as progress:
        write_sweep(out, sweep, progress)
