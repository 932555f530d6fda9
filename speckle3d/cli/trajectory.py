"""Trajectories as text, and one trajectory scored against another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from speckle3d.cli.common import Json, ReconstructionFile, app, emit, note
from speckle3d.cli.helping import App
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError

if TYPE_CHECKING:
    from speckle3d.io.tum import LengthUnit

trajectory = App(help="Trajectories as TUM text, and scores of them.")
app.add_typer(trajectory, name="trajectory")

Unit = Annotated[str, typer.Option("--length-unit", help="Unit of lengths in TUM text: m or mm.")]

_LABELS = (
    ("FDR_percent", "final drift rate (FDR)", "{:.2f} %"),
    ("ADR_percent", "average drift rate (ADR)", "{:.2f} %"),
    ("MD_mm", "maximum drift (MD)", "{:.4f} mm"),
    ("SD_mm", "sum of drift (SD)", "{:.3f} mm"),
    ("HD_mm", "Hausdorff distance (HD)", "{:.4f} mm"),
    ("EA_deg", "error of angle (EA)", "{:.4f} deg"),
    ("GPE_mm", "global pixel error (GPE)", "{:.4f} mm"),
    ("GLE_mm", "global landmark error (GLE)", "{:.4f} mm"),
    ("LPE_mm", "local pixel error (LPE)", "{:.4f} mm"),
    ("LLE_mm", "local landmark error (LLE)", "{:.4f} mm"),
    ("score", "TUS-REC score, 2025", "{:.3f}"),
)


@trajectory.command()
def export(
    reconstruction_file: ReconstructionFile,
    out: Annotated[
        Path,
        typer.Option("-o", "--output", help="Text file to write; ITK transform if it ends in .tfm or .h5."),
    ],
    mode: Annotated[
        str, typer.Option(help="Which poses to use: image, orientation, pose, crossed, fused.")
    ] = "image",
    length_unit: Unit = "m",
    frame: Annotated[
        str | None,
        typer.Option(
            metavar="N|all", help="Of a transform: which frame; all writes a file for each, ...-0000."
        ),
    ] = None,
) -> None:
    """Write the poses of one mode as TUM text (time_s x y z qx qy qz qw, image to world), or ITK transforms.

    Transforms are as 3D Slicer reads them: axes lead left, posterior and superior, mm.
    """
    from speckle3d.io.shapes.transforms import SUFFIXES
    from speckle3d.io.tum import write_tum
    from speckle3d.scoring.trajectories import load_reconstructed

    unit = cast("LengthUnit", length_unit)
    if out.suffix.lower() in SUFFIXES:
        _export_transforms(reconstruction_file, out, mode, frame)
        return
    if frame is not None:
        raise InvalidInputError(f"--frame {frame}: is of transforms ({', '.join(SUFFIXES)}), got {out.name}")
    require_own_place(out, "trajectory", reconstruction_file)
    held = load_reconstructed(reconstruction_file, mode)
    write_tum(out, held.time_s, held.poses, unit)


def _export_transforms(reconstruction_file: Path, out: Path, mode: str, frame: str | None) -> None:
    from speckle3d.io.shapes.transforms import transform_paths, write_transform, write_transforms
    from speckle3d.scoring.trajectories import load_reconstructed

    if frame is None:
        raise InvalidInputError(f"{out}: expected --frame N, or --frame all for a file of each, got neither")
    poses = load_reconstructed(reconstruction_file, mode).poses
    if frame == "all":
        for path in transform_paths(out, len(poses)):
            require_own_place(path, "transform", reconstruction_file)
        write_transforms(out, poses)
        return
    number = int(frame) if frame.isascii() and frame.isdecimal() else -1
    if not 0 <= number < len(poses):
        raise InvalidInputError(f"--frame: expected a number from 0 to {len(poses) - 1} or all, got {frame}")
    require_own_place(out, "transform", reconstruction_file)
    write_transform(out, poses[number])


@trajectory.command()
def score(
    estimate_file: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="TUM text or reconstruction.")],
    reference_file: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="TUM text, sweep, TUS-REC scan or reconstruction.")
    ],
    mode: Annotated[
        str | None,
        typer.Option(help="Poses of a reconstruction: image (by default) or another mode of it."),
    ] = None,
    reference: Annotated[str | None, typer.Option(help="Which poses of a sweep: tracker or truth.")] = None,
    length_unit: Annotated[
        str | None, typer.Option(help="Unit of lengths in TUM text that does not say: m (by default) or mm.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Score a trajectory: pose errors as evo has them, drift rates, displacement of pixels and landmarks."""
    from speckle3d.scoring.trajectories import compare_trajectories, load_estimate, load_reference
    from speckle3d.study.results import json_text

    _require_meaning(estimate_file, reference_file, mode, reference, length_unit)
    unit, chosen = cast("LengthUnit | None", length_unit), mode or "image"
    estimate = load_estimate(estimate_file, chosen, unit)
    found = compare_trajectories(estimate, load_reference(reference_file, reference, chosen, unit))
    if found["same_sweep"] is False:
        note(
            f"warning: {estimate.name} was made from another file than {reference_file.name} (SHA-256): "
            "the scores mean nothing unless both hold the same recording"
        )
    if as_json:
        emit(json_text(found))
        return
    emit(_table(found))
    if found["left_out"]:
        note(f"{found['left_out']} poses of {estimate.name} have no reference and were left out")
    if found["GPE_mm"] is None:
        note("neither file tells of images: drift is that of the poses' origin, and no pixels were scored")


def _require_meaning(
    estimate: Path, of: Path, mode: str | None, reference: str | None, length_unit: str | None
) -> None:
    """Refuse options that would have no effect on these files."""
    from speckle3d.scoring.trajectories import kind_of

    kinds = kind_of(estimate), kind_of(of)
    for name, value, kind, among in (
        ("--mode", mode, "reconstruction", kinds),
        ("--reference", reference, "sweep", kinds[1:]),
        ("--length-unit", length_unit, "text", kinds),
    ):
        if value is not None and kind not in among:
            where = " or ".join(among)
            words = "TUM text" if kind == "text" else f"a {kind}"
            raise InvalidInputError(f"{name} {value}: is of {words}, expected none with {where}")


def _table(found: dict[str, Any]) -> str:
    from speckle3d.core.tables import text_table

    rows = [
        ("poses", str(found["poses"])),
        ("matched", found["association"]),
        ("aligned", found["alignment"]),
    ]
    for name, words in (("APE", "absolute pose error (APE)"), ("RPE", "relative pose error (RPE)")):
        each = found[name]
        rows += [
            (f"{words}, RMS", f"{each.rmse_mm:.4f} mm, {each.rmse_deg:.4f} deg"),
            (f"{words}, largest", f"{each.max_mm:.4f} mm, {each.max_deg:.4f} deg"),
        ]
    rows += [(words, form.format(found[key])) for key, words, form in _LABELS if found[key] is not None]
    return text_table(rows, (0, 1), heading=False)
