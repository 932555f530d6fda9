"""What the report shows: the study's numbers, and of each sweep what its folder and the sweep itself hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.reconstruction import FramePairs, Reconstruction
from speckle3d.core.sweep import Sweep
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.hdf5 import sha256_of
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.matching.quality import describe
from speckle3d.scoring.references import Reference, SweepCurves, find_reference, sweep_curves
from speckle3d.study.results import FORMAT, VERSION

Record = Mapping[str, Any]


@dataclass(frozen=True)
class StudyData:
    """What ``study.json`` holds.

    Attributes
    ----------
    directory : path
        The study's folder.
    modes : list of str
        In the study's order.
    done, broken : list of mapping
        Entries of the sweeps with and without results.
    rows : list of mapping
        Errors by sweep, part and mode.
    drift, intervals, paired : list of mapping
        Drift by sweep and mode, means over sweeps, and modes compared in pairs.
    settings_toml : str
    """

    directory: Path
    modes: list[str]
    done: list[Record]
    broken: list[Record]
    rows: list[Record]
    drift: list[Record]
    intervals: list[Record]
    paired: list[Record]
    settings_toml: str

    @property
    def copies(self) -> dict[str, str]:
        """Sweeps whose bytes are those of an earlier one, and that one's name."""
        return {entry["name"]: entry["copy_of"] for entry in self.done if entry.get("copy_of")}

    @property
    def single(self) -> list[Record]:
        """Rows of all sweeps but copies."""
        copies = self.copies
        return [row for row in self.rows if row["sweep"] not in copies]

    @property
    def references(self) -> dict[str, str]:
        """What each sweep was compared with, copies left out."""
        return {row["sweep"]: row["reference"] for row in self.single if row.get("reference")}


@dataclass(frozen=True)
class RejectedPatches:
    """Share of the frame pairs in which each patch was left out, and of the patches in each frame.

    Attributes
    ----------
    centre_mm : ndarray, shape (p, 2)
    share : ndarray, shape (p,)
        NaN for a patch that never had a distance.
    frame_share : ndarray, shape (n,)
        By the pair's first frame; NaN where it began no pair.
    """

    centre_mm: FloatArray
    share: FloatArray
    frame_share: FloatArray


@dataclass(frozen=True)
class SweepView:
    """One sweep of a study, ready to be shown.

    Attributes
    ----------
    poses : dict of str to RigidTransform, each of length n
        By mode, in the first frame's image frame; the reference under its own name, if it covers every frame.
    own_poses : dict
        The same in their own worlds.
    sweep : Sweep or None
        None where the file is gone or changed; `notes` then says so.
    """

    name: str
    folder: Path
    reconstruction: Reconstruction
    curves: SweepCurves
    poses: dict[str, RigidTransform]
    own_poses: dict[str, RigidTransform]
    rejected: RejectedPatches | None
    sweep: Sweep | None
    details: Record
    notes: list[str] = field(default_factory=list)


def read_study(directory: Path) -> StudyData:
    """Read ``study.json``.

    Raises
    ------
    InvalidInputError
        If there is none, or it is not a study's.
    """
    path = directory / "study.json"
    if not path.is_file():
        raise InvalidInputError(f"{directory}: expected a study's folder with study.json, got none")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InvalidInputError(f"{path}: expected JSON, got an error: {error}") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InvalidInputError(f"{path}: expected format {FORMAT!r}, got another")
    if found.get("version") != VERSION:
        raise InvalidInputError(f"{path}: expected version {VERSION}, got {found.get('version')!r}")
    rows: list[Record] = [row for row in found.get("rows", []) if isinstance(row, dict)]
    return StudyData(
        directory,
        list(dict.fromkeys([*found.get("modes", []), *(row["mode"] for row in rows)])),
        [entry for entry in found["sweeps"] if entry.get("status") == "done"],
        [entry for entry in found["sweeps"] if entry.get("status") != "done"],
        rows,
        found.get("drift") or [],
        found.get("intervals") or [],
        found.get("paired") or [],
        str(found.get("settings_toml", "")),
    )


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
    found = read_reconstruction(folder / "reconstruction.h5")
    details = _read_details(folder)
    notes: list[str] = []
    sweep = _open_sweep(directory, entry, found, notes)
    reference = _open_reference(sweep, details, notes)
    own = dict(found.poses)
    if reference is not None and reference.covered.all():
        own[reference.name] = reference.world_from_image
    covariance = None if found.trust is None else found.trust.covariance
    if found.trust is not None:
        notes += [f"{line}: poses there are guesses" for line in describe(found.trust.flags)]
    return SweepView(
        name=str(entry["name"]),
        folder=folder,
        reconstruction=found,
        curves=sweep_curves(found.poses, found.grid.centre_mm, reference, covariance),
        poses={mode: each[0].inv() * each for mode, each in own.items()},
        own_poses=own,
        rejected=None if found.pairs is None else rejected_patches(found.pairs, found.frame_time_s.size),
        sweep=sweep,
        details=details,
        notes=notes,
    )


def rejected_patches(pairs: FramePairs, frames: int) -> RejectedPatches:
    """Count how often each patch, and each frame's patches, were left out though a distance was there."""
    measured = np.isfinite(pairs.distance_mm)
    left_out = measured & ~pairs.used
    by_frame = [np.bincount(pairs.first, each.sum(axis=1), frames) for each in (left_out, measured)]
    return RejectedPatches(
        pairs.patch_centre_mm, _share(left_out.sum(axis=0), measured.sum(axis=0)), _share(*by_frame)
    )


def _share(part: npt.ArrayLike, whole: npt.ArrayLike) -> FloatArray:
    counts = np.asarray(whole, dtype=float)
    return np.asarray(np.divide(part, counts, out=np.full(counts.shape, np.nan), where=counts > 0))


def _read_details(folder: Path) -> Record:
    """Read the sweep's summary as a mapping; empty where it is missing or cannot be read."""
    try:
        (summary,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _open_sweep(directory: Path, entry: Record, found: Reconstruction, notes: list[str]) -> Sweep | None:
    stored = Path(str(entry["path"]))
    path = stored if stored.is_file() else directory / stored
    missing = "so there is no reference in its curves and there are no reslices"
    if not path.is_file():
        notes.append(f"The sweep is no longer at {stored}, {missing}.")
        return None
    try:
        if sha256_of(path) != found.provenance.input_sha256:
            notes.append(f"The sweep at {stored} is no longer the one that was reconstructed, {missing}.")
            return None
        return apply_calibrations(load_sweep(path), [c.path for c in found.provenance.calibrations])[0]
    except Speckle3DError as error:
        notes.append(f"The sweep cannot be read ({error}), {missing}.")
        return None


def _open_reference(sweep: Sweep | None, details: Record, notes: list[str]) -> Reference | None:
    wanted = details.get("reference")
    if sweep is None or wanted == "none":
        return None
    try:
        return find_reference(sweep, wanted)
    except Speckle3DError as error:
        notes.append(f"The reference cannot be read: {error}")
        return None
