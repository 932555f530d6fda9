"""Distances, lengths and angles between points of a reconstructed sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import Json, ReconstructionFile, app, emit, emit_json
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.imaging.measure import Measurement


@app.command()
def measure(
    source: ReconstructionFile,
    mode: Annotated[
        str, typer.Option(help="Which poses the points were picked at: image, orientation, pose, ...")
    ] = "image",
    point: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z", help="A point of the world, mm; repeat it, in order."),
    ] = None,
    points: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Points in a file, with columns x_mm,y_mm,z_mm.")
    ] = None,
    pick_mm: Annotated[
        float | None,
        typer.Option(
            help="How well a point is picked, standard deviation per axis; by default half the "
            "distance of the image's vectors."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say how long it is between points, and how sure that is: distances, the line's length, angles.

    Standard errors are those of the poses of the frames on either side of each point, jointly, and of the
    picking.
    """
    from speckle3d.imaging.belonging import require_inside
    from speckle3d.imaging.measure import measured
    from speckle3d.io.picks import parse_point, read_places
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.study.pose_errors import posed_errors_of

    if (points is None) == (not point):
        raise InvalidInputError("expected --point X,Y,Z two or more times, or --points CSV")
    if pick_mm is not None and not 0.0 <= pick_mm < float("inf"):
        raise InvalidInputError(f"--pick-mm: expected zero or more, got {pick_mm}")
    held = read_reconstruction(source, with_pairs=False)
    errors = posed_errors_of(held, mode)
    places = read_places(points) if points is not None else parse_point(point or [])
    near = require_inside(places, held.grid, errors.world_from_image)
    picked = held.grid.vector_pitch_mm / 2 if pick_mm is None else pick_mm
    found = measured(places, near, errors, picked)
    if as_json:
        emit_json({"mode": mode, "pick_mm": picked, "measurements": [_plain(each) for each in found]})
    else:
        lines = [_line(each) for each in found]
        emit("\n".join([*lines, f"mode {mode}; points picked to {picked:.2g} mm per axis; 95 % in brackets"]))


def _plain(found: Measurement) -> dict[str, Any]:
    """A measurement as JSON has it, angles in degrees."""
    scale, unit = _shown(found)
    low, high = found.interval
    return {
        "kind": found.kind,
        "points": [number + 1 for number in found.points],
        "value": found.value * scale,
        "standard_error": found.sigma * scale,
        "by_poses": found.pose_sigma * scale,
        "by_picking": found.pick_sigma * scale,
        "interval_95": [low * scale, high * scale],
        "unit": unit,
    }


def _line(found: Measurement) -> str:
    scale, unit = _shown(found)
    low, high = (end * scale for end in found.interval)
    numbers = " ".join(str(number + 1) for number in found.points)
    errors = f"poses {found.pose_sigma * scale:.2f}, picking {found.pick_sigma * scale:.2f}"
    value, sigma = found.value * scale, found.sigma * scale
    return f"{found.kind} {numbers}: {value:.2f} +- {sigma:.2f} {unit} [{low:.2f}, {high:.2f}] ({errors})"


def _shown(found: Measurement) -> tuple[float, str]:
    return (1.0, "mm") if found.unit == "mm" else (57.29577951308232, "degrees")
