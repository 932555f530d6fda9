"""Trajectories as text, and one trajectory scored against another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from speckle3d.cli.common import Json, MaybeText, Out, Reference, emit, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError

LengthUnit = Literal["m", "mm"]


def export(
    reconstruction_file: Path,
    out: Out,
    mode: MaybeText = None,
    length_unit: LengthUnit = "m",
    frame: MaybeText = None,
) -> None:
    """Write the poses of one mode as TUM text (time_s x y z qx qy qz qw, image to world), or ITK transforms.

    Transforms are as 3D Slicer reads them: axes lead left, posterior and superior, mm.

    Parameters
    ----------
    reconstruction_file
    out
        Text file to write; ITK transform if it ends in .tfm.
    mode
    length_unit
        Unit of lengths in TUM text.
    frame
        Of a transform: number of the frame; or all, which writes a file for each, ...-0000.

    Examples
    --------
    $ speckle3d trajectory export out/reconstruction.h5 -o poses.tum --mode pose
    """
    from speckle3d.io.shapes.transforms import SUFFIX, transform_paths, write_transform, write_transforms
    from speckle3d.io.tum import write_tum
    from speckle3d.scoring.trajectories import load_estimate

    is_transform = out.suffix.lower() == SUFFIX
    if is_transform != (frame is not None):
        raise InvalidInputError(
            f"{out}: expected --frame N or --frame all with {SUFFIX}, and with no other name"
        )
    made = load_estimate(reconstruction_file, mode)
    note(made.name)
    if frame is None:
        require_own_place(out, "trajectory", reconstruction_file)
        write_tum(out, made.time_s, made.poses, length_unit)
        return
    count = len(made.poses)
    number = int(frame) if frame.isascii() and frame.isdecimal() else -1
    if frame != "all" and not 0 <= number < count:
        raise InvalidInputError(f"--frame: expected a number from 0 to {count - 1} or all, got {frame}")
    for path in transform_paths(out, count) if frame == "all" else [out]:
        require_own_place(path, "transform", reconstruction_file)
    if frame == "all":
        write_transforms(out, made.poses)
    else:
        write_transform(out, made.poses[number])


def score(
    estimate: Path,
    of: Annotated[Path, typer.Argument(metavar="REFERENCE")],
    mode: MaybeText = None,
    reference: Reference | None = None,
    length_unit: LengthUnit | None = None,
    as_json: Json = False,
) -> None:
    """Score a trajectory: pose errors as evo has them, drift rates, displacement of pixels and landmarks.

    Parameters
    ----------
    estimate
        TUM text or reconstruction.
    of
        TUM text, sweep, TUS-REC scan or reconstruction.
    mode, as_json

    Other Parameters
    ----------------
    reference
        Which poses of a sweep.
    length_unit
        Unit of lengths in TUM text that does not say (m).

    Examples
    --------
    $ speckle3d trajectory score out/reconstruction.h5 sweep.h5 --mode pose
    """
    from speckle3d.scoring.trajectories import compare_trajectories, load_estimate, load_reference
    from speckle3d.study.results import json_text

    loaded = load_estimate(estimate, mode, length_unit)
    found = compare_trajectories(loaded, load_reference(of, reference, mode, length_unit))
    if found["same_sweep"] is False:
        note(
            f"warning: {loaded.name} was made from another file than {of.name} (SHA-256): "
            "the scores mean nothing unless both hold the same recording"
        )
    if as_json:
        emit(json_text(found))
        return
    emit(_table(found))
    if found["left_out"]:
        note(f"{found['left_out']} poses of {loaded.name} have no reference and were left out")
    if found["GPE_mm"] is None:
        note("neither file tells of images: drift is that of the poses' origin, and no pixels were scored")


def _table(found: dict[str, Any]) -> str:
    from speckle3d.config import unit_of
    from speckle3d.core.tables import text_rows
    from speckle3d.scoring.displacements import MEANINGS

    rows = [(name, str(found[name]), "") for name in ("estimate", "poses")]
    for name, words in (("APE", "absolute pose error (APE)"), ("RPE", "relative pose error (RPE)")):
        error = found[name]
        rows.append((f"{words}, RMS", f"{error.rmse_mm:.4f} mm, {error.rmse_deg:.4f}", "deg"))
        rows.append((f"{words}, largest", f"{error.max_mm:.4f} mm, {error.max_deg:.4f}", "deg"))
    for name, meaning in {**MEANINGS, "score": "TUS-REC score, 2025"}.items():
        if found[name] is not None:
            words = f"{meaning.split(':')[0]} ({name.split('_')[0]})"
            rows.append((words, f"{found[name]:.4f}", unit_of(name) or "%" * name.endswith("percent")))
    return text_rows(rows)
