"""Sizes: between points of a reconstructed sweep, and of the surfaces of a volume."""

from pathlib import Path
from typing import Annotated, Any

import typer

import speckle3d as s3
from speckle3d.cli.common import MaybeNumber, MaybePath, MaybeText, Out, Result, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError, naming


def measure(
    reconstruction_file: Path,
    point: list[str] | None = None,
    points: MaybePath = None,
    on: MaybePath = None,
    mode: MaybeText = None,
    pick_mm: Annotated[MaybeNumber, typer.Option(min=0.0)] = None,
) -> Result:
    """Measure distances, a line's length and angles between points, with their errors.

    One of --point or --points. Errors are those of the poses of the frames on either side of each point,
    jointly, and of the picking.

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
    $ speckle3d measure out --mode image --point 3,10,1 --point 3,12,9
    """
    from speckle3d.io.points import PICTURE, WORLD, parse_places, read_places
    from speckle3d.scoring.modes import default_mode
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.pose_errors import PICKING, caution, how_measured
    from speckle3d.study.posed import pose_mark, require_made_at
    from speckle3d.study.reslices.cuts import read_plane

    columns = WORLD if on is None else PICTURE
    places = read_places(points, columns) if points is not None else parse_places(point or [], columns)
    reconstruction, why = s3.load_reconstruction(reconstruction_file, with_pairs=False), ""
    if on is not None:
        plane = read_plane(on, mode)
        require_made_at(plane.mark, pose_mark(poses_of(reconstruction, plane.mode)), str(on))
        places, mode = plane.world_mm(places), plane.mode
    elif mode is None:
        mode, why = default_mode(reconstruction)
    pick_mm = PICKING * reconstruction.grid.vector_pitch_mm if pick_mm is None else pick_mm
    measurements = s3.measure(reconstruction, places, mode, pick_mm)
    note(why, caution(reconstruction, mode))
    records = []
    for row in measurements:
        scale, unit = row.shown_in
        records.append(
            {
                "kind": row.kind,
                "points": [number + 1 for number in row.points],
                "value": row.value * scale,
                "standard_error": row.sigma * scale,
                "by_poses": row.pose_sigma * scale,
                "by_picking": row.pick_sigma * scale,
                "interval_95": [end * scale for end in row.interval],
                "unit": unit,
            }
        )
    numbers = {"mode": mode, "pick_mm": pick_mm, "measurements": records}
    lines = [*(measurement.line for measurement in measurements), how_measured(mode, pick_mm)]
    return numbers, "\n".join(lines)


def surface(
    volume_file: Path,
    out: Annotated[Out, "surface"],
    level: MaybeNumber = None,
    below: bool = False,
    labels: bool = False,
    smooth: Annotated[int, typer.Option(min=0)] = 0,
    largest: bool = False,
    reconstruction: MaybePath = None,
    mode: MaybeText = None,
    state: MaybePath = None,
) -> Result:
    """Find the surface where a volume crosses a grey level, or those of its labels, and measure them.

    One of --level or --labels. Where the sweep ends the surface stays open, and what is open has no volume;
    labels are closed there unless --state tells where it ends.

    Parameters
    ----------
    volume_file
        Volume: .nrrd, .mha or .nii.gz.
    out
        SURFACE.stl, .ply or .vtk to write; of labels, SURFACE-1.stl and so on.
    level
        Grey level on which the surface lies.
    below
        With --level: inside is darker than the level, as in a cyst or a vessel.
    labels
        VOLUME is a label map: a surface around each label.
    smooth
        Passes of smoothing.
    largest
        Keep only the largest connected part.
    reconstruction
        reconstruction.h5 that VOLUME was made from, for the errors of area and volume.
    as_json

    Other Parameters
    ----------------
    mode
        Poses that VOLUME was made at, if its file does not say (image).
    state
        Which voxels are empty, from `speckle3d volume --state`: there the surface ends, and stays open.
        Without it, of grey levels, zeros that reach the border.

    Examples
    --------
    $ speckle3d surface volume.nrrd -o cyst.stl --level 60 --below --largest
    """
    import numpy as np

    from speckle3d.core.volume import EMPTY
    from speckle3d.imaging.measures.surface import (
        largest_part,
        measures_of,
        smooth_surface,
        surfaces_of_labels,
    )
    from speckle3d.io.voxels.volumes import read_states
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.pose_errors import caution, errors_of
    from speckle3d.study.posed import MARK, pose_mark, require_made_at

    volume = s3.load_volume(volume_file)
    said, errors = volume.fields.get("poses"), tuple[Any, ...]()
    if mode is not None and said not in (None, mode):
        raise InvalidInputError(f"--mode: {volume_file} was made at the poses of {said}, got {mode}")
    if reconstruction is not None:
        posed = s3.load_reconstruction(reconstruction, with_pairs=False)
        volume_mode = mode or said or "image"
        with naming(f"{volume_file}: made at the poses of {volume_mode}"):
            mark = pose_mark(poses_of(posed, volume_mode))
        require_made_at(volume.fields.get(MARK, ""), mark, str(volume_file))
        note(caution(posed, volume_mode))
        errors = errors_of(posed, volume_mode), posed.grid
    mask = None if state is None else read_states(state, volume) != EMPTY
    if level is not None:
        surfaces = {out: s3.surface_of(volume, level, "below" if below else "above", mask)}
    else:
        by_label = surfaces_of_labels(volume, mask).items()
        surfaces = {out.with_stem(f"{out.stem}-{label}"): surface for label, surface in by_label}
        for place in surfaces:
            require_own_place(place, "surface")
        if mask is None:
            note("labels that reach the end of the sweep are closed there: --state leaves them open")
    sizes = []
    for place, mesh in surfaces.items():
        mesh = largest_part(mesh) if largest else mesh
        mesh = smooth_surface(mesh, smooth) if smooth else mesh
        s3.write_surface(place, mesh)
        about = {"parts": int(mesh.parts().max()) + 1, "size_mm": np.ptp(mesh.vertices_mm, axis=0)}
        sizes.append({"file": str(place), **vars(measures_of(mesh, *errors)), **about})
    return sizes, "\n".join(map(_line, sizes))


def _line(sizes: dict[str, Any]) -> str:
    words = [f"{sizes['triangles']} triangles", f"{sizes['parts']} part(s)"]
    words.append(" x ".join(f"{size:.1f}" for size in sizes["size_mm"]) + " mm")
    for name, unit in (("area", "mm2"), ("volume", "mm3")):
        value, sigma = sizes[f"{name}_{unit}"], sizes[f"{name}_sigma_{unit}"]
        if value is not None:
            error = "" if sigma is None else f" +- {1.96 * sigma:.1f} (95 %)"
            words.append(f"{name} {value:.1f}{error} {unit}")
    if sizes["open_mm"] > 0:
        words.append("the volume is of its closed parts" if sizes["volume_mm3"] else "no part is closed")
        words.append(f"open along {sizes['open_mm']:.1f} mm where the sweep or the grid ends")
    return f"{sizes['file']}: {', '.join(words)}"
