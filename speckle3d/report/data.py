"""What the report shows: a study's numbers, and of each sweep its results and its patches."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.matching.quality import describe
from speckle3d.scoring.references import SweepCurves, find_reference, sweep_curves, tracker_alone
from speckle3d.study.images import sweep_of
from speckle3d.study.results import VERSION, Summary, read_summary

Record = Mapping[str, Any]


class StudyData(BaseModel, frozen=True):
    """What ``study.json`` holds.

    Attributes
    ----------
    modes : list of str
        In the study's order.
    sweeps : list of dict
        Entries of all sweeps, with and without results.
    doubts : list of dict
        What of the recordings is in doubt, by sweep.
    rows : list of dict
        Errors by sweep, part and mode.
    drift, intervals, paired : list of dict
        Drift by sweep and mode, means over sweeps, and modes compared in pairs.
    """

    format: Literal["speckle3d.study"]
    version: Literal[2]
    sweeps: list[dict[str, Any]]
    doubts: list[dict[str, Any]] = []
    modes: list[str] = []
    rows: list[dict[str, Any]] = []
    drift: list[dict[str, Any]] = []
    intervals: list[dict[str, Any]] = []
    paired: list[dict[str, Any]] = []
    settings_toml: str = ""

    @property
    def done(self) -> list[dict[str, Any]]:
        """Entries of the sweeps with results."""
        return [entry for entry in self.sweeps if entry["status"] == "done"]

    @property
    def broken(self) -> list[dict[str, Any]]:
        """Entries of the sweeps without results."""
        return [entry for entry in self.sweeps if entry["status"] != "done"]

    @property
    def scored(self) -> list[dict[str, Any]]:
        """Rows with an error of length."""
        return [row for row in self.rows if row.get("length_error_percent") is not None]


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
    summary: Summary
    curves: SweepCurves
    poses: dict[str, RigidTransform]
    notes: list[str] = field(default_factory=list)


def read_study(directory: Path) -> StudyData:
    """Read ``study.json``.

    Raises
    ------
    InvalidInputError
        If there is none, or it is not a study's, or one of an older version.
    """
    path = directory / "study.json"
    if not path.is_file():
        raise InvalidInputError(f"{directory}: expected a study's folder with study.json, got none")
    try:
        return StudyData.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        name, got = ".".join(map(str, first["loc"])), repr(first["input"])[:60]
        raise InvalidInputError(
            f"{path}: {name}: {first['msg']}, got {got}: a study of version {VERSION} is made by "
            "`speckle3d compare`"
        ) from error
    except ValueError as error:
        raise InvalidInputError(f"{path}: expected JSON, got an error: {error}") from error


def load_view(directory: Path, entry: Record) -> SweepView:
    """Gather what there is to show of a sweep that is done.

    Parameters
    ----------
    directory : path
        The study's folder.
    entry : mapping
        Its entry in ``study.json``.

    Raises
    ------
    Speckle3DError
        If its reconstruction cannot be read.
    """
    folder = directory / str(entry["folder"])
    if not folder.resolve().is_relative_to(directory.resolve()):
        raise InvalidInputError(f"{directory}: expected a folder in the study's own, got {entry['folder']!r}")
    made = read_reconstruction(folder / "reconstruction.h5")
    summary, reference, poses = read_summary(folder, str(entry["name"])), None, dict(made.poses)
    notes = list(summary.lines)
    try:
        source = Path(str(entry["path"]))
        sweep = sweep_of(made, source if source.exists() else directory / source)
        alone = tracker_alone(sweep)
        if alone is not None and any(row.mode == "tracker" for row in summary.rows):
            poses["tracker"] = alone
        reference = None if summary.reference == "none" else find_reference(sweep, summary.reference)
        if reference is not None and reference.covered.all():
            poses[reference.name] = reference.world_from_image
    except Speckle3DError as error:
        notes.append(f"{error}: neither the reference nor the tracker is in its curves")
    covariance = None if made.trust is None else made.trust.covariance
    if made.trust is not None:
        notes += [f"{line}: poses there are guesses" for line in describe(made.trust.flags)]
    own = poses if reference is None else {m: p for m, p in poses.items() if m != reference.name}
    return SweepView(
        folder,
        made,
        summary,
        sweep_curves(own, made.grid.centre_mm, reference, covariance),
        poses,
        notes,
    )
