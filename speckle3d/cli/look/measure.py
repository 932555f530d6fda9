"""Distances, lengths and angles between points of a reconstructed sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from speckle3d.cli.common import Json, MaybeNumber, MaybePath, MaybeText, emit, emit_json, note
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.imaging.measures.measure import Measurement


def measure(
    reconstruction_file: Path,
    point: list[str] | None = None,
    points: MaybePath = None,
    on: MaybePath = None,
    mode: MaybeText = None,
    pick_mm: MaybeNumber = None,
    as_json: Json = False,
) -> None:
    """Say how long it is between points, and how sure that is: distances, the line's length, angles.

    Standard errors are those of the poses of the frames on either side of each point, jointly, and of the
    picking.

    Parameters
    ----------
    reconstruction_file
    point
        A point X,Y,Z of the world, mm; repeat it, in order.
    points
        Points in a file with columns x_mm,y_mm,z_mm.
    on
        Picture of `speckle3d reslice` in which the points were picked: X,Y then, by its axes.
    mode
        Which poses the points were picked at (by default those that claim the smallest error of length).
    pick_mm
        How well a point is picked, standard deviation per axis; by default half the distance of the image's
        vectors.
    as_json

    Examples
    --------
    $ speckle3d measure out/reconstruction.h5 --point 3,10,1 --point 3,12,9
    """
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.io.shapes.picks import PICTURE, WORLD, parse_places, read_places
    from speckle3d.scoring.modes import default_mode
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.pose_errors import PICKED, caution
    from speckle3d.study.pose_errors import measure as measure_points
    from speckle3d.study.reslices.cut_geometry import read_plane, require_same_poses

    columns = WORLD if on is None else PICTURE
    if (points is None) == (not point):
        wanted = "X,Y,Z" if on is None else "X,Y"
        raise InvalidInputError(f"expected --point {wanted} two or more times, or --points CSV")
    if pick_mm is not None and not 0.0 <= pick_mm < float("inf"):
        raise InvalidInputError(f"--pick-mm: expected zero or more, got {pick_mm}")
    places = read_places(points, columns) if points is not None else parse_places(point or [], columns)
    made, why = read_reconstruction(reconstruction_file, with_pairs=False), ""
    if on is not None:
        shown = read_plane(on, mode)
        require_same_poses(shown, poses_of(made, shown.mode), str(on))
        places, mode = shown.cut.world_from_mm(places[:, 0], places[:, 1]), shown.mode
    elif mode is None:
        mode, why = default_mode(made)
    picked = PICKED * made.grid.vector_pitch_mm if pick_mm is None else pick_mm
    found = measure_points(made, places, mode, picked)
    if as_json:
        emit_json({"mode": mode, "pick_mm": picked, "measurements": [_plain(each) for each in found]})
    else:
        for each in found:
            emit(each.line)
        emit(f"mode {mode}; points picked to {picked:.2g} mm per axis; +- a standard error, 95 % in brackets")
    for words in (why, caution(made, mode)):
        if words:
            note(words)


def _plain(measured: Measurement) -> dict[str, Any]:
    """A measurement as JSON has it, angles in degrees."""
    scale, unit = measured.shown_in
    numbers = {
        "value": measured.value,
        "standard_error": measured.sigma,
        "by_poses": measured.pose_sigma,
        "by_picking": measured.pick_sigma,
    }
    return {
        "kind": measured.kind,
        "points": [number + 1 for number in measured.points],
        **{name: value * scale for name, value in numbers.items()},
        "interval_95": [end * scale for end in measured.interval],
        "unit": unit,
    }
