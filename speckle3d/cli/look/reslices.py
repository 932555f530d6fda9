"""Cuts through a sweep, at the poses of one or more modes, or through a volume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from speckle3d.cli.common import MaybeNumber, MaybePath, MaybeText, Out
from speckle3d.cli.look.volumes import ImportOptions, SweepOptions, open_sweep_at
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.arrays import FloatArray
    from speckle3d.study.posed import SweepModes


def reslice(
    input_file: Path,
    out: Annotated[Out, "picture volume"],
    *,
    mode: list[str] | None = None,
    difference_to: MaybeText = None,
    lateral_mm: MaybeNumber = None,
    depth_mm: MaybeNumber = None,
    frame: int | None = None,
    angle_deg: float = 0.0,
    points: MaybeText = None,
    curve: MaybePath = None,
    on: MaybePath = None,
    pixel_mm: float = 0.2,
    choice: SweepOptions,
    dynamic_range_db: float = 50.0,
    recording: ImportOptions,
) -> None:
    """Cut a plane or along a curve, straight from the frames at the poses of one or more modes.

    Parameters
    ----------
    input_file
    out
        PNG to write; or .nrrd, .mha, .nii.gz: the cut at its place.
    mode
        Which poses to use, as in `volume`; repeated, modes stand side by side.
    lateral_mm
        Cut along the sweep at this lateral position (middle). Not with --depth-mm or --points or --curve.
    depth_mm
        Cut parallel to the skin at this depth. Not with --frame or --points or --curve.
    frame
        Cut in the plane of this frame, from 0. Not with --points or --curve.
    points
        Cut through three points of the world, 'X,Y,Z X,Y,Z X,Y,Z' in mm: of the first row and, in it, the
        first column, farther along it, and on the side of the columns. Not with --curve.
    curve
        CSV of a curve's points x_mm,y_mm,z_mm in the world: cut along it and into the depth.
    on
        With --curve: picture of `speckle3d reslice` with the curve's points: x_mm,y_mm then, by its axes.

    Other Parameters
    ----------------
    difference_to
        What modes are compared with (truth or tracker if known, else the first).
    angle_deg
        With --frame: turn out of it about its depth line; 90 is along the sweep.
    pixel_mm
        Side of a pixel.
    dynamic_range_db
        Range of the grey levels of RF and I/Q.
    region, sweep_file, calibration, tracker_transform

    Examples
    --------
    $ speckle3d reslice out/reconstruction.h5 -o cut.png --mode image --mode pose
    """
    from speckle3d.imaging.cuts.oblique import spanned_plane
    from speckle3d.io.points import parse_places
    from speckle3d.io.voxels.volume_writer import write_volume
    from speckle3d.study.posed import at_modes
    from speckle3d.study.reslices.cuts import cut_as_volume, cut_at_modes
    from speckle3d.study.reslices.places import along_curve, along_sweep, in_frame, in_world
    from speckle3d.study.reslices.reslice_figures import save_reslices

    plane = None
    if points is not None:
        corners = parse_places(points.split(), option="--points")
        if len(corners) != 3:
            raise InvalidInputError(f"--points: expected three, got {len(corners)}")
        plane = spanned_plane(corners[0], *(corners[1:] - corners[0]))
    first_mode = mode[:1] if mode else [None]
    (first,), part = open_sweep_at(first_mode, input_file, recording, choice)
    modes = at_modes(first, mode or (), difference_to)
    source, _ = modes.posed.source(None, dynamic_range_db)
    grid = source.grid
    if curve is not None:
        place = along_curve(modes, grid, _curve(curve, on, modes), pixel_mm)
    elif plane is not None:
        place = in_world(modes, grid, plane, pixel_mm)
    elif frame is not None:
        place = in_frame(modes, grid, frame, angle_deg, lateral_mm, pixel_mm)
    else:
        place = along_sweep(modes, grid, lateral_mm, depth_mm, pixel_mm)
    with progress_bar(f"reslicing {out.name}"):
        picture = cut_at_modes(modes, place, source, dynamic_range_db, part)
    if out.suffix.lower() == ".png":
        save_reslices(picture, out)
    else:
        write_volume(out, cut_as_volume(picture))


def _curve(path: Path, picture: Path | None, modes: SweepModes) -> FloatArray:
    """Points of a curve in the world, read as such or as points of a picture of the mode that is cut."""
    from speckle3d.io.points import PICTURE, WORLD, read_places
    from speckle3d.study.posed import require_made_at
    from speckle3d.study.reslices.cut_geometry import read_plane

    if picture is None:
        return read_places(path, WORLD)
    plane = read_plane(picture, modes.reference)
    require_made_at(plane.mark, modes.marks[modes.reference], str(picture))
    return plane.world_mm(read_places(path, PICTURE))
