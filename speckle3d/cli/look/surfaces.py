"""Surfaces of a volume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import Json, app, emit, emit_json, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.core.pose_errors import PosedErrors
    from speckle3d.core.surface import Surface
    from speckle3d.core.sweep import ImageGrid
    from speckle3d.core.volume import Volume


@app.command()
def surface(
    source: Annotated[Path, typer.Argument(metavar="VOLUME", help="Volume: .nrrd, .mha or .nii.gz.")],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="SURFACE.stl, .ply or .vtk to write; of labels, SURFACE-1.stl and so on."
        ),
    ],
    level: Annotated[float | None, typer.Option(help="Grey level on which the surface lies.")] = None,
    below: Annotated[
        bool, typer.Option("--below", help="Inside is darker than the level, as in a cyst or a vessel.")
    ] = False,
    labels: Annotated[
        bool, typer.Option("--labels", help="VOLUME is a label map: a surface around each label.")
    ] = False,
    smooth: Annotated[int, typer.Option(help="Passes of smoothing.")] = 0,
    largest: Annotated[bool, typer.Option("--largest", help="Keep only the largest connected part.")] = False,
    reconstruction: Annotated[
        Path | None,
        typer.Option(
            help="reconstruction.h5 that VOLUME was made from, for standard errors of area and volume."
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(help="Poses that VOLUME was made at, if its file does not say (image)."),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            help="Which voxels are empty, from `speckle3d volume --state`; without it, of a volume of whole "
            "numbers, zeros that reach its border."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find the surface where a volume crosses a grey level, or those of its labels, and measure them.

    Where the sweep ends the surface stays open, and what is open has no volume.
    """
    from speckle3d.core.labels import EMPTY
    from speckle3d.imaging.measures.surface import largest_part, smoothed, surface_of, surfaces_of_labels
    from speckle3d.io.shapes.surfaces import require_suffix, write_surface
    from speckle3d.io.voxels.volumes import read_states, read_volume

    if labels == (level is not None):
        raise InvalidInputError("expected --level or --labels, one of them")
    if labels and (below or state is not None):
        raise InvalidInputError("--labels: expected no --below and no --state beside it")
    if smooth < 0:
        raise InvalidInputError(f"--smooth: expected zero or more passes, got {smooth}")
    suffix = require_suffix(out)
    if not labels:
        require_own_place(out, "surface", source, reconstruction, state)
    volume = read_volume(source)
    made_at = volume.fields.get("poses", mode or "image")
    if mode is not None and mode != made_at:
        raise InvalidInputError(f"--mode: expected {made_at}, at whose poses VOLUME was made, got {mode}")
    errors, grid = _errors(reconstruction, made_at, volume, source)
    known = None if state is None else read_states(state, volume) != EMPTY
    if level is not None:
        found = {str(out): surface_of(volume, level, "below" if below else "above", known)}
    else:
        each_label = surfaces_of_labels(volume).items()
        found = {str(out.with_name(f"{out.stem}-{label}{suffix}")): each for label, each in each_label}
        for place in found:
            require_own_place(Path(place), "surface", source, reconstruction)
    told = []
    for place, each in found.items():
        whole = largest_part(each) if largest else each
        final = smoothed(whole, smooth) if smooth else whole
        write_surface(place, final)
        told.append(_sizes(place, whole, final, errors, grid))
    if as_json:
        emit_json(told)
    else:
        emit("\n".join(_line(each) for each in told))


def _errors(
    path: Path | None, mode: str, volume: Volume, source: Path
) -> tuple[PosedErrors | None, ImageGrid | None]:
    """Errors of the poses that a volume was made at."""
    if path is None:
        return None, None
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.pose_errors import caution, posed_errors_of
    from speckle3d.study.posed import require_made_at

    held = read_reconstruction(path, with_pairs=False)
    require_made_at(volume, poses_of(held, mode), str(source))
    if (words := caution(held, mode)) is not None:
        note(words)
    return posed_errors_of(held, mode), held.grid


def _sizes(
    place: str, rough: Surface, surface: Surface, errors: PosedErrors | None, grid: ImageGrid | None
) -> dict[str, Any]:
    """What is said of one surface."""
    from dataclasses import asdict

    from speckle3d.imaging.measures.surface import measures_of

    found = measures_of(surface, errors, grid)
    parts = int(surface.parts().max()) + 1
    low, high = surface.vertices_mm.min(axis=0), surface.vertices_mm.max(axis=0)
    sizes = {"file": place, **asdict(found), "parts": parts, "size_mm": (high - low).tolist()}
    if surface is not rough:
        before = measures_of(rough)
        sizes["smoothing_changed_area"] = surface.area_mm2 / before.area_mm2 - 1.0
        if found.volume_mm3 is not None and before.volume_mm3:
            sizes["smoothing_changed_volume"] = found.volume_mm3 / before.volume_mm3 - 1.0
    return sizes


def _line(found: dict[str, Any]) -> str:
    words = [f"{found['triangles']} triangles", f"{found['parts']} part{'s' if found['parts'] > 1 else ''}"]
    words.append(" x ".join(f"{size:.1f}" for size in found["size_mm"]) + " mm")
    words.append(f"area {_with_error(found['area_mm2'], found['area_sigma_mm2'])} mm2")
    if found["volume_mm3"] is not None:
        words.append(f"volume {_with_error(found['volume_mm3'], found['volume_sigma_mm3'])} mm3")
    if found["open_mm"] > 0:
        closed = "" if found["volume_mm3"] is None else " (volume of the closed parts)"
        words.append(f"open along {found['open_mm']:.1f} mm where the sweep or the grid ends{closed}")
    if "smoothing_changed_volume" in found:
        words.append(f"smoothing changed the volume by {100 * found['smoothing_changed_volume']:+.2f} %")
    return f"{found['file']}: {', '.join(words)}"


def _with_error(value: float, sigma: float | None) -> str:
    return f"{value:.1f}" if sigma is None else f"{value:.1f} +- {sigma:.1f}"
