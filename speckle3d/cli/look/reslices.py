"""Cuts through a reconstructed or tracked sweep, or through a volume."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import CalibrationFiles, PosedFile, SweepFile, Transform, app, note
from speckle3d.cli.importing import (
    Importing,
    Number,
    PlusConfig,
    ReferenceTransform,
    files_of,
)
from speckle3d.cli.look.compounding import LevelRange, said_of
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.arrays import ByteArray, FloatArray
    from speckle3d.core.volume import Volume
    from speckle3d.study.reslices.cuts import CutPicture, OpenedModes
    from speckle3d.study.reslices.places import Place

Triple = tuple[float, float, float]

_OF_SWEEPS = (
    "calibration", "plus_config", "transform", "reference_transform", "column_pitch_mm", "row_spacing_mm",
    "frame_rate_hz",
)  # fmt: skip
"""Options that say what a recording does not say itself."""


@app.command(cls=Importing)
def reslice(
    source: PosedFile,
    out: Annotated[
        Path,
        typer.Option("-o", "--output", help="PNG to write; or .nrrd, .mha, .nii.gz: the cut at its place."),
    ],
    mode: Annotated[
        list[str] | None,
        typer.Option(help="Which poses to use, as in `volume`; repeated, modes stand side by side."),
    ] = None,
    difference_to: Annotated[
        str | None,
        typer.Option(
            metavar="MODE", help="What modes are compared with (truth or tracker if known, else the first)."
        ),
    ] = None,
    lateral_mm: Annotated[
        float | None, typer.Option(help="Cut along the sweep at this lateral position (middle).")
    ] = None,
    depth_mm: Annotated[float | None, typer.Option(help="Cut parallel to the skin at this depth.")] = None,
    frame: Annotated[int | None, typer.Option(help="Cut in the plane of this frame, from 0.")] = None,
    angle_deg: Annotated[
        float, typer.Option(help="With --frame: turn out of it about its depth line; 90 is along the sweep.")
    ] = 0.0,
    points: Annotated[
        str | None,
        typer.Option(metavar="'X,Y,Z X,Y,Z X,Y,Z'", help="Cut through three points of the world, mm."),
    ] = None,
    origin: Annotated[Triple | None, typer.Option(help="Cut through this point of the world, mm.")] = None,
    right: Annotated[
        Triple | None, typer.Option(help="With --origin: direction of the picture's rows.")
    ] = None,
    down: Annotated[
        Triple | None, typer.Option(help="With --origin or --curve: direction of its columns (curve: depth).")
    ] = None,
    curve: Annotated[
        Path | None,
        typer.Option(
            help="CSV of a curve's points x_mm,y_mm,z_mm in the world: cut along it and into the depth."
        ),
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option(
            metavar="CUT.png",
            help="Picture of `speckle3d reslice` with the curve's points: x_mm,y_mm then, by its axes.",
        ),
    ] = None,
    straight: Annotated[
        bool, typer.Option("--straight", help="Join the curve's points by straight lines, not by a spline.")
    ] = False,
    outlines: Annotated[bool, typer.Option("--outlines", help="Draw where the frames are instead.")] = False,
    volume: Annotated[Path | None, typer.Option(help="Cut this volume of the sweep, not its frames.")] = None,
    state: Annotated[
        Path | None,
        typer.Option(help="What `volume --state` wrote: empty voxels are not shown."),
    ] = None,
    pixel_mm: Annotated[float, typer.Option(help="Side of a pixel.")] = 0.2,
    reach_mm: Annotated[float, typer.Option(help="Frames farther from a pixel do not count.")] = 0.5,
    sweep_file: SweepFile = None,
    dynamic_range_db: LevelRange = None,
    calibration: CalibrationFiles = None,
    plus_config: PlusConfig = None,
    transform: Transform = None,
    reference_transform: ReferenceTransform = None,
    column_pitch_mm: Number = None,
    row_spacing_mm: Number = None,
    frame_rate_hz: Number = None,
) -> None:
    """Cut a plane or along a curve, straight from the frames at the poses of one or more modes."""
    from speckle3d.io.voxels.volume_writer import SUFFIXES
    from speckle3d.io.voxels.volumes import may_be_volume
    from speckle3d.study.figures import RANGE_DB
    from speckle3d.study.reslices.cuts import cut_posed
    from speckle3d.study.reslices.places import Place
    from speckle3d.study.reslices.reslice_figures import save_outlines

    options = locals()
    as_volume = out.name.lower().endswith(SUFFIXES)
    read = (source, sweep_file, curve, on, volume, state, *files_of(plus_config, calibration))
    require_own_place(out, "volume" if as_volume else "picture", *read)
    _require_one_place(
        {"--lateral-mm": lateral_mm if frame is None else None, "--depth-mm": depth_mm, "--frame": frame,
         "--points": points, "--origin": origin, "--curve": curve}
    )  # fmt: skip
    _require_together({"--angle-deg": angle_deg or None, "--frame": frame}, {"--on": on, "--curve": curve},
                      {"--right": right, "--origin": origin})  # fmt: skip
    place = Place(
        lateral_mm,
        depth_mm,
        frame,
        angle_deg,
        _points(points),
        _vector(origin),
        _vector(right),
        _vector(down),
        smooth=not straight,
        pixel_mm=pixel_mm,
        reach_mm=reach_mm,
    )

    def located(opened: OpenedModes | None) -> Place:
        return place if curve is None else replace(place, curve_mm=_curve(curve, on, opened))

    modes = tuple(mode or ())
    if outlines:
        save_outlines(_open(source, modes, difference_to, options), out)
    elif source.is_file() and may_be_volume(source):
        others = {name: options[name] for name in (*_OF_SWEEPS, "difference_to", "volume", "sweep_file")}
        _require_no_sweep({"mode": modes, **others})
        _cut_volume(source, state, out, located(None))
    else:
        _require_together({"--state": state, "--volume": volume})
        voxels = None if volume is None else _voxels(volume, state)
        if voxels is not None:
            modes = _modes_of(voxels[0], modes)
        opened = _open(source, modes, difference_to, options)
        if voxels is not None:
            _require_of_volume(opened, voxels[0], str(volume))
        with progress_bar(f"reslicing {out.name}") as progress:
            range_db = dynamic_range_db or RANGE_DB
            picture = cut_posed(opened, located(opened), range_db, voxels, progress)
        _write(picture, out)


def _open(
    source: Path, modes: tuple[str, ...], reference: str | None, options: Mapping[str, Any]
) -> OpenedModes:
    """Open a sweep with what options say of it, and say on stderr which frames have no pose."""
    from speckle3d.study.reslices.cuts import open_modes

    opened = open_modes(source, modes, reference, *said_of(source, options))
    for line in opened.posed.notes():
        note(line)
    return opened


def _require_of_volume(opened: OpenedModes, volume: Volume, where: str) -> None:
    """Refuse a volume beside several modes, or one made at other poses."""
    from speckle3d.study.posed import require_made_at

    if len(opened.poses) > 1:
        raise InvalidInputError(f"--mode: expected one beside --volume, got {', '.join(opened.poses)}")
    require_made_at(volume, opened.poses[opened.reference], where)


def _modes_of(volume: Volume, modes: tuple[str, ...]) -> tuple[str, ...]:
    """The mode whose world a volume lies in, if its file says so: cuts must be placed in the same one."""
    made_at = volume.fields.get("poses")
    if made_at is None:
        return modes
    if modes and modes != (made_at,):
        raise InvalidInputError(
            f"--mode: expected {made_at}, at whose poses --volume was made, got {', '.join(modes)}"
        )
    return (made_at,)


def _cut_volume(source: Path, state: Path | None, out: Path, place: Place) -> None:
    from speckle3d.study.reslices.cuts import cut_voxels

    volume, states = _voxels(source, state)
    _write(cut_voxels(volume, place, source.name, states), out)


def _voxels(path: Path, state: Path | None) -> tuple[Volume, ByteArray | None]:
    """Read a volume and, if there is a file of them, the states of its voxels."""
    from speckle3d.io.voxels.volumes import read_states, read_volume

    volume = read_volume(path)
    return volume, None if state is None else read_states(state, volume)


def _write(picture: CutPicture, out: Path) -> None:
    """Write a cut as a volume of one plane if the name says so, else as a picture."""
    from speckle3d.io.voxels.volume_writer import SUFFIXES
    from speckle3d.io.voxels.volumes import write_volume
    from speckle3d.study.reslices.cuts import cut_as_volume
    from speckle3d.study.reslices.reslice_figures import save_reslices

    if out.name.lower().endswith(SUFFIXES):
        write_volume(out, cut_as_volume(picture))
    else:
        save_reslices(picture, out)


def _require_one_place(given: dict[str, object]) -> None:
    named = [name for name, value in given.items() if value is not None]
    if len(named) > 1:
        raise InvalidInputError(f"expected one of {', '.join(given)}; got {' and '.join(named)}")


def _require_together(*pairs: dict[str, object]) -> None:
    """Refuse an option, the first of each pair, without the one it belongs to."""
    for pair in pairs:
        (name, value), (other, needed) = pair.items()
        if value is not None and needed is None:
            raise InvalidInputError(f"{name}: expected {other} with it, got none")


def _require_no_sweep(given: dict[str, object]) -> None:
    for name, value in given.items():
        if value:
            option = "--" + ("sweep" if name == "sweep_file" else name.replace("_", "-"))
            raise InvalidInputError(
                f"{option}: expected a reconstruction or a recording with it, got a volume"
            )


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
