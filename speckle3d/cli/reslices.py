"""Cuts through a reconstructed or tracked sweep, or through a volume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import DynamicRange, PosedFile, SweepFile, app, progress_bar
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.core.arrays import FloatArray
    from speckle3d.study.places import Place

Triple = tuple[float, float, float]


@app.command()
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
    outlines: Annotated[bool, typer.Option("--outlines", help="Draw where the frames are instead.")] = False,
    volume: Annotated[Path | None, typer.Option(help="Cut this volume of the sweep, not its frames.")] = None,
    pixel_mm: Annotated[float, typer.Option(help="Side of a pixel.")] = 0.2,
    reach_mm: Annotated[float, typer.Option(help="Frames farther from a pixel do not count.")] = 0.5,
    sweep_file: SweepFile = None,
    dynamic_range_db: DynamicRange = 60.0,
) -> None:
    """Cut a plane or along a curve, straight from the frames at the poses of one or more modes."""
    from speckle3d.io.volume_writer import SUFFIXES
    from speckle3d.study.places import Place

    as_volume = out.name.lower().endswith(SUFFIXES)
    require_own_place(out, "volume" if as_volume else "picture", source, sweep_file, curve, volume)
    _require_one_place(
        {"--lateral-mm": lateral_mm if frame is None else None, "--depth-mm": depth_mm, "--frame": frame,
         "--points": points, "--origin": origin, "--curve": curve}
    )  # fmt: skip
    place = Place(
        lateral_mm,
        depth_mm,
        frame,
        angle_deg,
        _points(points),
        _vector(origin),
        _vector(right),
        _vector(down),
        None if curve is None else _curve(curve),
        pixel_mm=pixel_mm,
        reach_mm=reach_mm,
    )
    modes = tuple(mode or ())
    if outlines:
        _draw_outlines(source, out, modes, difference_to, sweep_file)
        return
    if _is_volume(source):
        _require_no_modes(modes, difference_to, volume)
        _cut_volume(source, out, place, as_volume)
    else:
        _cut_sweep(source, out, place, modes, difference_to, volume, sweep_file, dynamic_range_db)


def _cut_sweep(
    source: Path,
    out: Path,
    place: Place,
    modes: tuple[str, ...],
    difference_to: str | None,
    volume: Path | None,
    sweep_file: Path | None,
    dynamic_range_db: float,
) -> None:
    from speckle3d.io.volumes import read_volume, write_volume
    from speckle3d.study.cuts import cut_as_volume, cut_posed, open_modes
    from speckle3d.study.reslice_figures import save_reslices

    opened = open_modes(source, modes, difference_to, sweep_file)
    as_volume = not out.name.lower().endswith(".png")
    if (as_volume or volume is not None) and len(opened.poses) > 1:
        what = "a volume file" if as_volume else "--volume"
        raise InvalidInputError(f"--mode: expected one mode for {what}, got {', '.join(opened.poses)}")
    voxels = None if volume is None else read_volume(volume)
    with progress_bar(f"reslicing {out.name}") as progress:
        picture = cut_posed(opened, place, dynamic_range_db, voxels, progress)
    if not as_volume:
        save_reslices(picture, out)
        return
    write_volume(out, cut_as_volume(picture))


def _draw_outlines(
    source: Path, out: Path, modes: tuple[str, ...], difference_to: str | None, sweep_file: Path | None
) -> None:
    from speckle3d.imaging.outlines import frame_outlines
    from speckle3d.matching.intensity import IntensityExtractor
    from speckle3d.study.cuts import open_modes
    from speckle3d.study.figures import save_figure
    from speckle3d.study.reslice_figures import figure_outlines

    opened = open_modes(source, modes, difference_to, sweep_file)
    grid = IntensityExtractor.for_sweep(opened.posed.sweep).grid
    outlines = {mode: frame_outlines(grid, poses[0].inv() * poses) for mode, poses in opened.poses.items()}
    save_figure(figure_outlines(outlines, opened.posed.sweep.name), out)


def _cut_volume(source: Path, out: Path, place: Place, as_volume: bool) -> None:
    from speckle3d.io.volumes import read_volume, write_volume
    from speckle3d.study.cuts import cut_as_volume, cut_voxels
    from speckle3d.study.reslice_figures import save_reslices

    picture = cut_voxels(read_volume(source), place, source.name)
    if as_volume:
        write_volume(out, cut_as_volume(picture))
    else:
        save_reslices(picture, out)


def _is_volume(path: Path) -> bool:
    from speckle3d.cli.outputs import is_volume

    return path.is_file() and is_volume(path)


def _require_one_place(given: dict[str, object]) -> None:
    named = [name for name, value in given.items() if value is not None]
    if len(named) > 1:
        raise InvalidInputError(f"expected one of {', '.join(given)}; got {' and '.join(named)}")


def _require_no_modes(modes: tuple[str, ...], difference_to: str | None, volume: Path | None) -> None:
    for name, value in (("--mode", modes), ("--difference-to", difference_to), ("--volume", volume)):
        if value:
            raise InvalidInputError(f"{name}: expected a reconstruction or a recording with it, got a volume")


def _vector(values: Triple | None) -> FloatArray | None:
    import numpy as np

    return None if values is None else np.array(values)


def _points(text: str | None) -> FloatArray | None:
    import numpy as np

    from speckle3d.io.text import numbers

    if text is None:
        return None
    return np.array([numbers(word.replace(",", " "), 3, "--points") for word in text.split()])


def _curve(path: Path) -> FloatArray:
    """Points of a CSV with the heading ``x_mm,y_mm,z_mm``; more columns are ignored."""
    import numpy as np

    from speckle3d.io.text import numbers, text_lines

    wanted = ("x_mm", "y_mm", "z_mm")
    lines = ((number, line) for number, line in text_lines(path) if not line.startswith("#"))
    number, heading = next(lines, (1, ""))
    columns = [name.strip() for name in heading.split(",")]
    if not set(wanted) <= set(columns):
        raise InvalidInputError(
            f"{path}: line {number}: expected columns {','.join(wanted)}, got {heading[:60]!r}"
        )
    at = [columns.index(name) for name in wanted]
    rows = [numbers(line.replace(",", " "), len(columns), f"{path}: line {number}") for number, line in lines]
    return np.array(rows, dtype=float).reshape(len(rows), len(columns))[:, at]
