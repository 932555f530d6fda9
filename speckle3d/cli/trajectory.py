"""Trajectories as text, and one trajectory scored against another."""

from pathlib import Path
from typing import Annotated, Any

import typer

from speckle3d.cli.common import MaybeText, Out, Reference, Result, note


def export(
    reconstruction_file: Path,
    out: Annotated[Out, "trajectory"],
    mode: MaybeText = None,
) -> None:
    """Write the poses of one mode as TUM text (time_s x y z qx qy qz qw, image to world, s and m).

    Parameters
    ----------
    reconstruction_file
    out
        Text file to write.
    mode
        Which poses to write (by default those that claim the smallest error of length).

    Examples
    --------
    $ speckle3d trajectory export out/reconstruction.h5 -o poses.tum --mode pose
    """
    from speckle3d.io.tum import write_tum
    from speckle3d.scoring.trajectories import load_estimate

    estimate = load_estimate(reconstruction_file, mode)
    note(estimate.name)
    write_tum(out, estimate.time_s, estimate.poses)


def score(
    estimate: Path,
    of: Annotated[Path, typer.Argument(metavar="REFERENCE")],
    mode: MaybeText = None,
    reference: Reference | None = None,
) -> Result:
    """Score a trajectory: pose errors as evo has them, drift rates, displacement of pixels and landmarks.

    Parameters
    ----------
    estimate
        TUM text or reconstruction.
    of
        TUM text, sweep, TUS-REC scan or reconstruction.
    mode
        Which poses of a reconstruction (by default those that claim the smallest error of length).
    as_json

    Other Parameters
    ----------------
    reference
        Which poses of a sweep.

    Examples
    --------
    $ speckle3d trajectory score out/reconstruction.h5 sweep.h5 --mode pose
    """
    from speckle3d.scoring.trajectories import compare_trajectories, load_estimate, load_reference

    trajectory = load_estimate(estimate, mode)
    scores = compare_trajectories(trajectory, load_reference(of, reference, mode))
    if scores["same_sweep"] is False:
        note(
            f"warning: {trajectory.name} was made from another file than {of.name} (SHA-256): "
            "the scores mean nothing unless both hold the same recording"
        )
    if scores["left_out"]:
        note(f"{scores['left_out']} poses of {trajectory.name} have no reference and were left out")
    if scores["GPE_mm"] is None:
        note("neither file tells of images: drift is that of the poses' origin, and no pixels were scored")
    return scores, _table(scores)


def _table(scores: dict[str, Any]) -> str:
    from speckle3d.config import unit_of
    from speckle3d.core.text import text_rows
    from speckle3d.scoring.displacements import MEANINGS

    rows = [(name, str(scores[name]), "") for name in ("estimate", "poses")]
    for name, noun in (("APE", "absolute pose error (APE)"), ("RPE", "relative pose error (RPE)")):
        error = scores[name]
        rows += [
            (f"{noun}, RMS", f"{error.rmse_mm:.4f} mm, {error.rmse_deg:.4f}", "deg"),
            (f"{noun}, largest", f"{error.max_mm:.4f} mm, {error.max_deg:.4f}", "deg"),
        ]
    for name, meaning in {**MEANINGS, "score": "TUS-REC score, 2025"}.items():
        if scores[name] is not None:
            words = f"{meaning.split(':')[0]} ({name.split('_')[0]})"
            rows.append((words, f"{scores[name]:.4f}", unit_of(name) or "%" * name.endswith("percent")))
    return text_rows(rows)
