"""Data of the report for each sweep of a study: results, curves, patches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import Speckle3DError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.examine.frames import describe
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.scoring.lengths import TRACKER
from speckle3d.scoring.references import SweepCurves, find_reference, sweep_curves, tracker_alone
from speckle3d.study.images import sweep_of
from speckle3d.study.results import SweepOutcome


@dataclass(frozen=True)
class SweepView:
    """One sweep of a study, ready to be shown.

    Attributes
    ----------
    poses : dict of str to RigidTransform, each of length n
        By mode, in their own worlds; the tracker's and the reference's, too, if they cover every frame.
    """

    folder: Path
    reconstruction: Reconstruction
    curves: SweepCurves
    poses: dict[str, RigidTransform]
    notes: list[str]


def load_view(directory: Path, outcome: SweepOutcome) -> SweepView:
    """Gather poses, curves and notes of a sweep with results.

    Parameters
    ----------
    directory : path
        The study's folder.
    outcome : SweepOutcome

    Raises
    ------
    Speckle3DError
        If its reconstruction cannot be read.
    """
    folder, summary, reference = directory / outcome.folder, outcome.summary, None
    assert summary is not None
    reconstruction = read_reconstruction(folder / "reconstruction.h5")
    notes, poses = list(summary.lines), dict(reconstruction.poses)
    try:
        sweep = sweep_of(reconstruction, outcome.path)
        tracker = tracker_alone(sweep)
        if tracker is not None and any(row.mode == TRACKER for row in summary.rows):
            poses[TRACKER] = tracker
        reference = None if summary.reference == "none" else find_reference(sweep, summary.reference)
        if reference is not None and reference.covered.all():
            poses[reference.name] = reference.world_from_image
    except Speckle3DError as error:
        notes.append(f"{error}: neither the reference nor the tracker is in its curves")
    covariance = None
    if reconstruction.trust is not None:
        covariance = reconstruction.trust.covariance
        notes += describe(reconstruction.trust.flags)
    curves = sweep_curves(poses, reconstruction.grid.centre_mm, reference, covariance)
    return SweepView(folder, reconstruction, curves, poses, notes)
