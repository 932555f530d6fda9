"""Distances, lengths and angles between points of a reconstructed sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import Json, ReconstructionFile, app, emit, emit_json, note
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.core.arrays import FloatArray
    from speckle3d.core.reconstruction import Reconstruction
    from speckle3d.imaging.measures.measure import Measurement


@app.command()
def measure(
    source: ReconstructionFile,
    point: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z", help="A point of the world, mm; repeat it, in order."),
    ] = None,
    points: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Points in a file with columns x_mm,y_mm,z_mm.")
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option(
            metavar="CUT.png",
            help="Picture of `speckle3d reslice` in which the points were picked: X,Y then, by its axes.",
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(help="Which poses the points were picked at: image (default), orientation, pose, ..."),
    ] = None,
    pick_mm: Annotated[
        float | None,
        typer.Option(
            help="How well a point is picked, standard deviation per axis; by default half the distance of "
            "the image's vectors."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say how long it is between points, and how sure that is: distances, the line's length, angles.

    Standard errors are those of the poses of the frames on either side of each point, jointly, and of the
    picking.
    """
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.io.shapes.picks import PICTURE, WORLD, parse_places, read_places
    from speckle3d.study.pose_errors import PICKED, caution
    from speckle3d.study.pose_errors import measure as measure_points

    columns = WORLD if on is None else PICTURE
    if (points is None) == (not point):
        wanted = "X,Y,Z" if on is None else "X,Y"
        raise InvalidInputError(f"expected --point {wanted} two or more times, or --points CSV")
    if pick_mm is not None and not 0.0 <= pick_mm < float("inf"):
        raise InvalidInputError(f"--pick-mm: expected zero or more, got {pick_mm}")
    places = read_places(points, columns) if points is not None else parse_places(point or [], columns)
    held = read_reconstruction(source, with_pairs=False)
    if on is not None:
        places, mode = _in_world(on, places, mode, held)
    picked = PICKED * held.grid.vector_pitch_mm if pick_mm is None else pick_mm
    found = measure_points(held, places, mode or "image", picked)
    told = f"mode {mode or 'image'}; points picked to {picked:.2g} mm per axis; 95 % in brackets"
    if as_json:
        rows = [_plain(each) for each in found]
        emit_json({"mode": mode or "image", "pick_mm": picked, "measurements": rows})
    else:
        emit("\n".join([*(each.line for each in found), told]))
    if (words := caution(held, mode or "image")) is not None:
        note(words)


def _in_world(
    picture: Path, places: FloatArray, mode: str | None, held: Reconstruction
) -> tuple[FloatArray, str]:
    """Points of the world that lie under points of a picture, and the mode whose poses it shows."""
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.reslices.cut_geometry import read_plane, require_same_poses

    shown = read_plane(picture, mode)
    require_same_poses(shown, poses_of(held, shown.mode), str(picture))
    return shown.cut.world_from_mm(places[:, 0], places[:, 1]), shown.mode


def _plain(found: Measurement) -> dict[str, Any]:
    """A measurement as JSON has it, angles in degrees."""
    scale, unit = found.shown_in
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
