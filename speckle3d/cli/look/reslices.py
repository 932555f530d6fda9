"""Cuts through a sweep, at the poses of one or more modes, or through a volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from speckle3d.cli.calibrations import files_of, given_settings
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import MaybeNumber, MaybePath, MaybeText, Out, Paths, notes
from speckle3d.cli.look.volumes import Imported, region_of
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.arrays import ByteArray, FloatArray
    from speckle3d.core.volume import Volume
    from speckle3d.study.reslices.cuts import OpenedModes

_PLACED = ("lateral_mm", "depth_mm", "frame", "angle_deg", "pixel_mm", "reach_mm")
Triple = tuple[float, float, float]


def reslice(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    difference_to: MaybeText = None,
    placed: Annotated[dict[str, Any], Fields("speckle3d.study.reslices.places:Place", _PLACED)],
    points: MaybeText = None,
    origin: Triple | None = None,
    right: Triple | None = None,
    down: Triple | None = None,
    curve: MaybePath = None,
    on: MaybePath = None,
    straight: bool = False,
    outlines: bool = False,
    volume: MaybePath = None,
    state: MaybePath = None,
    region: MaybeText = None,
    sweep_file: MaybePath = None,
    dynamic_range_db: MaybeNumber = None,
    calibration: Paths = None,
    transform: MaybeText = None,
    imported: Imported,
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
        Cut along the sweep at this lateral position (middle). Not with --depth-mm or --points or --origin
        or --curve.
    depth_mm
        Cut parallel to the skin at this depth. Not with --frame or --points or --origin or --curve.
    frame
        Cut in the plane of this frame, from 0. Not with --points or --origin or --curve.
    points
        Cut through three points of the world, 'X,Y,Z X,Y,Z X,Y,Z' in mm. Not with --origin or --curve.
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
    origin
        Cut through this point of the world, mm. Not with --curve.
    right
        With --origin: direction of the picture's rows.
    down
        With --origin or --curve: direction of its columns (curve: depth).
    straight
        Join the curve's points by straight lines, not by a spline.
    outlines
        Draw where the frames are instead. Not with --volume or --region.
    volume
        Cut this volume of the sweep, not its frames. Not with --difference-to or --region or --reach-mm.
    state
        What `volume --state` wrote: empty voxels are not shown.
    pixel_mm
        Side of a pixel.
    reach_mm
        Frames farther from a pixel do not count.
    dynamic_range_db
        Range of log-compressed grey levels (60).
    region, sweep_file, calibration, transform

    Examples
    --------
    $ speckle3d reslice out/reconstruction.h5 -o cut.png --mode image --mode pose
    """
    from speckle3d.io.shapes.picks import parse_places
    from speckle3d.io.voxels.volume_writer import SUFFIXES, write_volume
    from speckle3d.io.voxels.volumes import may_be_volume
    from speckle3d.study.figures import RANGE_DB
    from speckle3d.study.posed import open_posed, require_made_at
    from speckle3d.study.reslices.cuts import at_modes, cut_as_volume, cut_posed, cut_voxels
    from speckle3d.study.reslices.places import Place
    from speckle3d.study.reslices.reslice_figures import save_outlines, save_reslices

    as_volume = out.name.lower().endswith(SUFFIXES)
    read = (input_file, sweep_file, curve, on, volume, state, *files_of(imported, calibration))
    require_own_place(out, "volume" if as_volume else "picture", *read)
    corners = None if points is None else parse_places(points.split(), option="--points")
    place = Place(**placed, points_mm=corners, origin_mm=origin, right=right, down=down, smooth=not straight)

    def located(opened: OpenedModes | None) -> Place:
        return place if curve is None else replace(place, curve_mm=_curve(curve, on, opened))

    if input_file.is_file() and may_be_volume(input_file) and not outlines:
        of_sweeps = {**imported, "mode": mode, "volume": volume, "sweep": sweep_file, "region": region,
                     "calibration": calibration, "transform": transform, "difference_to": difference_to,
                     "dynamic_range_db": dynamic_range_db}  # fmt: skip
        for name in (name for name, value in of_sweeps.items() if value):
            flag = name.replace("_", "-")
            raise InvalidInputError(f"--{flag}: expected a sweep with it, got the volume {input_file.name}")
        voxels, states = _voxels(input_file, state)
        picture = cut_voxels(voxels, located(None), input_file.name, states)
    else:
        if state is not None and volume is None:
            raise InvalidInputError("--state: expected --volume with it, got none")
        made = None if volume is None else _voxels(volume, state)
        modes = _modes_of(None if made is None else made[0], mode or ())
        imports = given_settings(input_file, imported, transform)
        stated = sweep_file, imports, calibration or (), dynamic_range_db
        first = open_posed(input_file, modes[0] if modes else None, *stated)
        opened = at_modes(first, modes, difference_to)
        notes(opened.posed.notes())
        if outlines and as_volume:
            raise InvalidInputError(f"{out}: expected a picture of --outlines, as .png")
        if outlines:
            save_outlines(opened, out)
            return
        if made is not None:
            require_made_at(made[0], opened.poses[opened.reference], str(volume))
        part = region_of(region, input_file, stated, first)
        with progress_bar(f"reslicing {out.name}") as progress:
            range_db = dynamic_range_db or RANGE_DB
            picture = cut_posed(opened, located(opened), range_db, made, progress, region=part)
    if as_volume:
        write_volume(out, cut_as_volume(picture))
    else:
        save_reslices(picture, out)


def _modes_of(volume: Volume | None, modes: Sequence[str]) -> Sequence[str]:
    """Modes to cut: of a volume the one in whose world it lies, if its file says so."""
    if volume is None:
        return modes
    made_at = volume.fields.get("poses")
    if len(modes) > 1 or (modes and made_at not in (None, *modes)):
        raise InvalidInputError(
            f"--mode: expected {made_at or 'one'}, at whose poses --volume was made, got {', '.join(modes)}"
        )
    return modes if made_at is None else (made_at,)


def _voxels(path: Path, state: Path | None) -> tuple[Volume, ByteArray | None]:
    """Read a volume and, if there is a file of them, the states of its voxels."""
    from speckle3d.io.voxels.volumes import read_states, read_volume

    volume = read_volume(path)
    return volume, None if state is None else read_states(state, volume)


def _curve(path: Path, picture: Path | None, opened: OpenedModes | None) -> FloatArray:
    """Points of a curve in the world, read as such or as points of a picture of the mode that is cut."""
    from speckle3d.io.shapes.picks import PICTURE, WORLD, read_places
    from speckle3d.study.reslices.cut_geometry import read_plane, require_same_poses

    if picture is None:
        return read_places(path, WORLD)
    x, y = read_places(path, PICTURE).T
    shown = read_plane(picture, None if opened is None else opened.reference)
    if opened is not None:
        require_same_poses(shown, opened.poses[opened.reference], str(picture), opened.posed.frames)
    return shown.cut.world_from_mm(x, y)
