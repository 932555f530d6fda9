"""A sweep at poses: its voxels, scenes for 3D Slicer, and cuts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel

import speckle3d as s3
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    MaybeNumber,
    MaybePath,
    MaybeText,
    Out,
    Result,
    WritablePath,
    clip_of,
    note,
)
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.core.grid import Region
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.study.posed import PosedSweep

_IMPORTED = (
    "plus_config",
    "reference_transform",
    "tracker_transform",
    "column_pitch_mm",
    "row_spacing_mm",
    "frame_rate_hz",
)
ImportOptions = Annotated[Any, Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say."""
_SETTINGS = "speckle3d.imaging.voxels.settings:CompoundingSettings"
_SCENE = ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db")


class SweepChoice(BaseModel):
    """Options of a sweep at poses: which file, with which calibrations, and what part of its images."""

    region: str | None = None
    sweep_file: Path | None = None
    calibration: list[Path] | None = None


SweepOptions = Annotated[Any, Fields("speckle3d.cli.look.volumes:SweepChoice")]


def compounding_settings(config_file: Path | None, options: CompoundingSettings) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.io.toml import validated

    base, values = s3.load_config(config_file).volume, options.model_dump(exclude_unset=True)
    return validated(base.model_dump() | values, "volume", type(base))


def open_sweep_at(
    modes: Sequence[str | None],
    source: Path,
    settings: s3.ImportSettings,
    choice: SweepChoice,
) -> tuple[list[PosedSweep], Region | None]:
    """Open a sweep at the poses of each mode (None: the best), and note on stderr what it says of itself.

    The second result is the part of the images that counts: as asked for, else that to which a device set of
    PLUS clips volumes.
    """
    from speckle3d.calibrating.recordings import require_unsaid
    from speckle3d.core.grid import Region
    from speckle3d.io.import_settings import settings_for
    from speckle3d.study.posed import open_posed

    require_unsaid(source, settings)
    options = choice.sweep_file, settings, choice.calibration or ()
    sweeps = [open_posed(source, mode, *options) for mode in modes]
    first = sweeps[0]
    note(*first.notes())
    clip = clip_of(settings_for(source, settings).plus_config, first.sweep.grid, first.skew_rad)
    region = choice.region or clip
    return sweeps, None if region is None else Region(region)


def volume(
    input_file: Path,
    out: Annotated[Out, "volume"],
    *,
    mode: MaybeText = None,
    settings: Annotated[Any, Fields(_SETTINGS)],
    grid: Annotated[Any, Fields("speckle3d.study.scenes.voxels:GridRequest")],
    choice: SweepOptions,
    state: Annotated[WritablePath, "volume labels"] = None,
    deviation: Annotated[WritablePath, "volume"] = None,
    recording: ImportOptions,
    config_file: MaybePath = None,
) -> Result:
    """Compound the frames into voxels, at the poses of one mode or of the recording itself.

    Parameters
    ----------
    input_file
    out
        VOLUME.nrrd, .mha, .nii.gz or .nii to write.
    mode, voxel_mm
    rule
        Of a voxel's samples: mean, maximum, latest, weighted by how well each frame's place is known; plus:
        in whole grey levels as PLUS and 3D Slicer keep it (mean).
    fill_radius
        Voxels across which holes are filled (3); 0: none.
    dynamic_range_db, calibration, as_json

    Other Parameters
    ----------------
    splat, fill_mm, voxel_type, levels
    backward_mm
        For sparse sweeps, voxels between the nearest images, at most so far away. Not with --splat or
        --rule or --fill-radius or --fill-mm.
    axes
        Of the voxels: sweep (mean of the images), world, principal (smallest box).
    spacing_mm
        Voxels' sides along each axis. Not with --voxel-mm.
    origin_mm
        Centre of the first voxel in the world.
    shape
        Number of voxels along each axis.
    size_mm
        Size along each axis, mm. Not with --shape.
    within_gb
        The finest round one of a volume no larger than this. Not with --voxel-mm or --spacing-mm or --shape.
    like
        A volume whose grid to take. Not with --voxel-mm or --axes or --spacing-mm or --origin-mm or --shape
        or --size-mm or --within-gb.
    region
    state
        Write which voxels are measured and filled, as labels.
    deviation
        Write each voxel's standard deviation of position along the sweep, mm.
    max_memory_gb, sweep_file, config_file, tracker_transform

    Examples
    --------
    $ speckle3d volume out/reconstruction.h5 -o volume.nrrd
    """
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import write_voxels

    compounding = compounding_settings(config_file, settings)
    (posed,), part = open_sweep_at([mode], input_file, recording, choice)
    with s3.progress_bar(f"compounding {out.name}"):
        report = write_voxels(posed, compounding, out, grid, part, state, deviation)
    if deviation is not None and posed.reconstruction is not None:
        note(caution(posed.reconstruction, posed.mode))
    note(report.line)
    return report.summary(), ""


def scene(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[Any, Fields(_SETTINGS, _SCENE)],
    choice: SweepOptions,
    recording: ImportOptions,
    config_file: MaybePath = None,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames.

    Parameters
    ----------
    input_file
    out
        Folder to write into; open its scene.mrml.
    mode
        As for `volume`; may be repeated.
    images
        Also the images, which play as they move through the volume.
    voxel_mm, calibration

    Other Parameters
    ----------------
    deviation
        Also each voxel's standard deviation of position, mm.
    splat, rule, fill_radius, region, dynamic_range_db, sweep_file, config_file, tracker_transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.results import require_own
    from speckle3d.study.scenes.scene import FILES

    require_own(out, FILES)
    for path in filter(None, (input_file, choice.sweep_file)):
        if path.resolve() in {(out / name).resolve() for name in FILES.names}:
            raise InvalidInputError(f"{path}: is an input and would be replaced: give -o another folder")
    compounding = compounding_settings(config_file, settings)
    modes = list(dict.fromkeys(mode)) if mode else [None]
    sweeps, part = open_sweep_at(modes, input_file, recording, choice)
    with s3.progress_bar(f"writing {out.name}") as progress:
        reports = s3.write_scene(out, sweeps, compounding, part, images, deviation, progress)
    for report in reports:
        note(report.line)


def reslice(
    input_file: Path,
    out: Annotated[Out, "picture volume"],
    *,
    mode: list[str] | None = None,
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
    from speckle3d.io.points import PICTURE, WORLD, parse_places, read_places
    from speckle3d.study.posed import at_modes, require_made_at
    from speckle3d.study.reslices.cuts import cut_as_volume, cut_at_modes, read_plane
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
    modes = at_modes(first, mode or ())
    source, _ = modes.posed.source(None, dynamic_range_db)
    grid = source.grid
    if curve is not None and on is not None:
        picture = read_plane(on, modes.reference)
        require_made_at(picture.mark, modes.marks[modes.reference], str(on))
        place = along_curve(modes, grid, picture.world_mm(read_places(curve, PICTURE)), pixel_mm)
    elif curve is not None:
        place = along_curve(modes, grid, read_places(curve, WORLD), pixel_mm)
    elif plane is not None:
        place = in_world(modes, grid, plane, pixel_mm)
    elif frame is not None:
        place = in_frame(modes, grid, frame, angle_deg, lateral_mm, pixel_mm)
    else:
        place = along_sweep(modes, grid, lateral_mm, depth_mm, pixel_mm)
    with s3.progress_bar(f"reslicing {out.name}"):
        cut = cut_at_modes(modes, place, source, dynamic_range_db, part)
    if out.suffix.lower() == ".png":
        save_reslices(cut, out)
    else:
        s3.write_volume(out, cut_as_volume(cut))
