"""A sweep at poses: its voxels, scenes for 3D Slicer, and cuts through it or through a volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from speckle3d.cli.calibrations import files_of, given_settings
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    Json,
    MaybeNumber,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    Written,
    emit_json,
    from_options,
    load_settings,
    note,
    notes,
)
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.arrays import ByteArray, FloatArray
    from speckle3d.core.volume import Volume
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep
    from speckle3d.study.reslices.cuts import OpenedModes

    Statement = tuple[Path | None, ImportSettings, Sequence[Path], float | None]

_IMPORTED = ("plus_config", "reference_transform", "column_pitch_mm", "row_spacing_mm", "frame_rate_hz")
Imported = Annotated[dict[str, Any], Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say; the range of its grey levels is that of the levels made."""


def compounding_settings(config_file: Path | None, options: Mapping[str, Any]) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.imaging.voxels.settings import CompoundingSettings

    base = load_settings(config_file).volume.model_dump()
    if options.get("levels") == "linear" and base["voxel_type"] == "uint8":
        base["voxel_type"] = "float32"  # amplitudes may be less than one, or thousands
    return from_options(CompoundingSettings, base | dict(options))


def open_sweep_at(modes: Sequence[str | None], source: Path, stated: Statement) -> list[PosedSweep]:
    """Open a sweep at the poses of each mode (None: the best), and say on stderr which frames have none.

    Of a recording it is told what was assumed of its images; nothing where a calibration gives its pixels.
    """
    from speckle3d.io.import_settings import MissingSettingsError
    from speckle3d.io.load import import_notes
    from speckle3d.study.posed import open_posed

    opened = [open_posed(source, mode, *stated) for mode in modes]
    if opened[0].reconstruction is None:
        # Grey levels as stored need no dynamic range.
        ranged = stated[1].model_copy(update={"dynamic_range_db": 60.0})
        with suppress(MissingSettingsError):
            notes(line for line in import_notes(source, ranged) if not line.startswith("dynamic range"))
    notes(opened[0].notes())
    return opened


def _clip_of(source: Path, stated: Statement, posed: PosedSweep) -> str | None:
    """Region of the images that a device set of PLUS clips volumes to; None without one."""
    from speckle3d.io.import_settings import settings_for
    from speckle3d.io.plus.device_set import read_device_set

    config = settings_for(source, stated[1]).plus_config
    clip = None if config is None else read_device_set(config).clip
    return None if clip is None else clip.region_text(replace(posed.sweep.grid, skew_rad=posed.skew_rad))


Three = tuple[float, float, float]


def volume(
    input_file: Path,
    out: Out,
    *,
    mode: MaybeText = None,
    settings: Annotated[
        dict[str, Any],
        Fields("speckle3d.imaging.voxels.settings:CompoundingSettings"),
    ],
    axes: Literal["sweep", "world", "principal"] = "sweep",
    spacing_mm: Three | None = None,
    origin_mm: Three | None = None,
    shape: tuple[int, int, int] | None = None,
    size_mm: Three | None = None,
    within_gb: MaybeNumber = None,
    like: MaybePath = None,
    region: MaybeText = None,
    state: Written = None,
    deviation: Written = None,
    sweep_file: MaybePath = None,
    calibration: Paths = None,
    transform: MaybeText = None,
    imported: Imported,
    config_file: MaybePath = None,
    as_json: Json = False,
) -> None:
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
        The finest round one of a volume no larger than this. Not with --voxel-mm or --spacing-mm.
    like
        A volume whose grid to take. Not with --voxel-mm.
    region
    state
        Write which voxels are measured and filled, as labels.
    deviation
        Write each voxel's standard deviation of position along the sweep, mm.
    max_memory_gb, sweep_file, config_file, transform

    Examples
    --------
    $ speckle3d volume out/reconstruction.h5 -o volume.nrrd
    """
    from speckle3d.core.region import Region
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import GridRequest, VolumeRequest, write_voxels

    inputs = (input_file, sweep_file, like, *files_of(imported, calibration))
    places: dict[Path, str] = {}
    for flag, path in {"--output": out, "--state": state, "--deviation": deviation}.items():
        if path is not None:
            require_own_place(path, "volume", *inputs)
            if (other := places.setdefault(path.resolve(), flag)) != flag:
                raise InvalidInputError(f"{flag}: expected another file than {other}, got {path} for both")
    checked = compounding_settings(config_file, settings)
    imports = given_settings(input_file, imported, transform)
    stated = sweep_file, imports, calibration or (), settings.get("dynamic_range_db")
    (posed,) = open_sweep_at([mode], input_file, stated)
    region = region or _clip_of(input_file, stated, posed)
    request = VolumeRequest(
        out,
        checked,
        GridRequest(axes, spacing_mm, origin_mm, shape, size_mm, within_gb, like),
        None if region is None else Region(region),
        state,
        deviation,
    )
    with progress_bar(f"compounding {out.name}") as progress:
        report = write_voxels(posed, request, progress)
    if as_json:
        emit_json(report.summary())
    made = posed.reconstruction
    if deviation is not None and made is not None and (words := caution(made, posed.mode)) is not None:
        note(words)
    note(report.line)


def scene(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "speckle3d.imaging.voxels.settings:CompoundingSettings",
            ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db"),
        ),
    ],
    sweep_file: MaybePath = None,
    calibration: Paths = None,
    transform: MaybeText = None,
    imported: Imported,
    config_file: MaybePath = None,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames.

    Parameters
    ----------
    input_file
    out
        Folder to write; open its scene.mrml.
    mode
        As for `volume`; may be repeated.
    images
        Also the images, which play as they move through the volume.
    voxel_mm, calibration

    Other Parameters
    ----------------
    deviation
        Also each voxel's standard deviation of position, mm.
    splat, rule, fill_radius, dynamic_range_db, sweep_file, config_file, transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.scenes.scene import SceneRequest, require_scene_place, write_scene

    require_scene_place(out, input_file, sweep_file, *files_of(imported, calibration))
    imports = given_settings(input_file, imported, transform)
    stated = sweep_file, imports, calibration or (), settings.get("dynamic_range_db")
    request = SceneRequest(
        compounding_settings(config_file, settings), with_images=images, with_deviation=deviation
    )
    posed = open_sweep_at(mode or [None], input_file, stated)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, progress)
    for report in reports:
        note(report.line)


Triple = tuple[float, float, float]


def reslice(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    difference_to: MaybeText = None,
    lateral_mm: MaybeNumber = None,
    depth_mm: MaybeNumber = None,
    frame: int | None = None,
    angle_deg: float = 0.0,
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
    pixel_mm: float = 0.2,
    reach_mm: float = 0.5,
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
        Draw where the frames are instead.
    volume
        Cut this volume of the sweep, not its frames.
    state
        What `volume --state` wrote: empty voxels are not shown.
    pixel_mm
        Side of a pixel.
    reach_mm
        Frames farther from a pixel do not count.
    dynamic_range_db
        Range of log-compressed grey levels (60).
    sweep_file, calibration, transform

    Examples
    --------
    $ speckle3d reslice out/reconstruction.h5 -o cut.png --mode image --mode pose
    """
    from speckle3d.io.voxels.volume_writer import SUFFIXES, write_volume
    from speckle3d.io.voxels.volumes import may_be_volume
    from speckle3d.study.figures import RANGE_DB
    from speckle3d.study.posed import open_posed
    from speckle3d.study.reslices.cuts import at_modes, cut_as_volume, cut_posed, cut_voxels
    from speckle3d.study.reslices.places import Place
    from speckle3d.study.reslices.reslice_figures import save_outlines, save_reslices

    as_volume = out.name.lower().endswith(SUFFIXES)
    read = (input_file, sweep_file, curve, on, volume, state, *files_of(imported, calibration))
    require_own_place(out, "volume" if as_volume else "picture", *read)
    place = Place(
        lateral_mm, depth_mm, frame, angle_deg, _points(points), _vector(origin), _vector(right),
        _vector(down), smooth=not straight, pixel_mm=pixel_mm, reach_mm=reach_mm,
    )  # fmt: skip

    def located(opened: OpenedModes | None) -> Place:
        return place if curve is None else replace(place, curve_mm=_curve(curve, on, opened))

    if input_file.is_file() and may_be_volume(input_file) and not outlines:
        of_sweeps = {
            **imported,
            "mode": mode,
            "volume": volume,
            "sweep": sweep_file,
            "calibration": calibration,
            "transform": transform,
            "difference_to": difference_to,
            "dynamic_range_db": dynamic_range_db,
        }
        for name, value in of_sweeps.items():
            if value:
                flag = name.replace("_", "-")
                raise InvalidInputError(
                    f"--{flag}: expected a sweep with it, got the volume {input_file.name}"
                )
        voxels, states = _voxels(input_file, state)
        picture = cut_voxels(voxels, located(None), input_file.name, states)
    else:
        if state is not None and volume is None:
            raise InvalidInputError("--state: expected --volume with it, got none")
        read_voxels = None if volume is None else _voxels(volume, state)
        modes = _modes_of(None if read_voxels is None else read_voxels[0], mode or ())
        imports = given_settings(input_file, imported, transform)
        stated = sweep_file, imports, calibration or (), dynamic_range_db
        first = open_posed(input_file, modes[0] if modes else None, *stated)
        opened = at_modes(first, modes, difference_to)
        notes(opened.posed.notes())
        if outlines:
            save_outlines(opened, out)
            return
        if read_voxels is not None:
            _require_of_volume(opened, read_voxels[0], str(volume))
        with progress_bar(f"reslicing {out.name}") as progress:
            range_db = dynamic_range_db or RANGE_DB
            picture = cut_posed(opened, located(opened), range_db, read_voxels, progress)
    if as_volume:
        write_volume(out, cut_as_volume(picture))
    else:
        save_reslices(picture, out)


def _require_of_volume(opened: OpenedModes, volume: Volume, where: str) -> None:
    """Refuse a volume beside several modes, or one made at other poses."""
    from speckle3d.study.posed import require_made_at

    if len(opened.poses) > 1:
        raise InvalidInputError(f"--mode: expected one beside --volume, got {', '.join(opened.poses)}")
    require_made_at(volume, opened.poses[opened.reference], where)


def _modes_of(volume: Volume | None, modes: Sequence[str]) -> Sequence[str]:
    """The mode whose world a volume lies in, if its file says so: cuts must be placed in the same one."""
    made_at = None if volume is None else volume.fields.get("poses")
    if made_at is None:
        return modes
    if modes and list(modes) != [made_at]:
        raise InvalidInputError(
            f"--mode: expected {made_at}, at whose poses --volume was made, got {', '.join(modes)}"
        )
    return (made_at,)


def _voxels(path: Path, state: Path | None) -> tuple[Volume, ByteArray | None]:
    """Read a volume and, if there is a file of them, the states of its voxels."""
    from speckle3d.io.voxels.volumes import read_states, read_volume

    volume = read_volume(path)
    return volume, None if state is None else read_states(state, volume)


def _vector(values: Triple | None) -> FloatArray | None:
    import numpy as np

    return None if values is None else np.array(values)


def _points(text: str | None) -> FloatArray | None:
    from speckle3d.io.shapes.picks import parse_places

    return None if text is None else parse_places(text.split(), option="--points")


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
