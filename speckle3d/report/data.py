"""What the report shows: a study's numbers, and of each sweep its results, its own data and reslices.

Reslices run along the sweep at the poses of every mode, with one detail of each enlarged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ValidationError
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.reconstruction import FramePairs, Reconstruction
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.load import load_sweep, recording_sha256
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.matching.quality import describe
from speckle3d.scoring.references import SweepCurves, find_reference, sweep_curves
from speckle3d.study.images import PIXEL_MM, cut_frames, grey_images, middle_planes, middle_vectors

Record = Mapping[str, Any]

DETAIL_PIXEL_MM = 0.04
DETAIL_MM = 5.0
"""Widest enlarged detail; four fifths as high."""

_DETAIL_SHARE = 0.4
"""Largest width of the detail as a share of the shortest reslice."""

NEAR_FIELD_MM = 4.0
_DYNAMIC_RANGE_DB = 55.0


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
    version: Literal[1]
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
        return [entry for entry in self.sweeps if entry.get("status") == "done"]

    @property
    def broken(self) -> list[dict[str, Any]]:
        """Entries of the sweeps without results."""
        return [entry for entry in self.sweeps if entry.get("status") != "done"]

    @property
    def copies(self) -> dict[str, str]:
        """Sweeps whose bytes are those of an earlier one, and that one's name."""
        return {entry["name"]: entry["copy_of"] for entry in self.done if entry.get("copy_of")}

    @property
    def single(self) -> list[dict[str, Any]]:
        """Rows of all sweeps but copies."""
        return [row for row in self.rows if row["sweep"] not in self.copies]

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
        By mode, in their own worlds; the reference under its own name, if it covers every frame.
    sweep : Sweep or None
        None where the file is gone or changed; `notes` then says so.
    """

    folder: Path
    reconstruction: Reconstruction
    curves: SweepCurves
    poses: dict[str, RigidTransform]
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
        return StudyData.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        name, got = ".".join(map(str, first["loc"])), repr(first["input"])[:60]
        raise InvalidInputError(f"{path}: {name}: {first['msg']}, got {got}") from error
    except (ValueError, RecursionError) as error:
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
    folder = _inside(directory, str(entry["folder"]))
    found = read_reconstruction(folder / "reconstruction.h5")
    details = _read_details(folder)
    notes = [Doubt(**each).consequence for each in details.get("doubts", ())]
    notes += [f"Mode {mode} is left out." for mode in details.get("left_out", ())]
    sweep = _open_sweep(directory, entry, found, notes)
    reference = None
    if sweep is not None and details.get("reference") != "none":
        try:
            reference = find_reference(sweep, details.get("reference"))
        except Speckle3DError as error:
            notes.append(f"The reference cannot be read: {error}")
    own = dict(found.poses)
    if reference is not None and reference.covered.all():
        own[reference.name] = reference.world_from_image
    covariance = None if found.trust is None else found.trust.covariance
    if found.trust is not None:
        notes += [f"{line}: poses there are guesses" for line in describe(found.trust.flags)]
    return SweepView(
        folder=folder,
        reconstruction=found,
        curves=sweep_curves(found.poses, found.grid.centre_mm, reference, covariance),
        poses=own,
        rejected=None if found.pairs is None else rejected_patches(found.pairs, found.frame_time_s.size),
        sweep=sweep,
        details=details,
        notes=notes,
    )


def _inside(directory: Path, name: str) -> Path:
    """Folder of a sweep's results, which is nowhere but in the study's."""
    folder = directory / name
    if not folder.resolve().is_relative_to(directory.resolve()):
        raise InvalidInputError(f"{directory}: expected a folder in the study's own, got {name!r}")
    return folder


def rejected_patches(pairs: FramePairs, frames: int) -> RejectedPatches:
    """Count how often each patch, and each frame's patches, were left out though a distance was there."""
    measured = np.isfinite(pairs.distance_mm)
    left_out = measured & ~pairs.used
    by_patch = (each.sum(axis=0) for each in (left_out, measured))
    by_frame = (np.bincount(pairs.first, each.sum(axis=1), frames) for each in (left_out, measured))
    return RejectedPatches(pairs.patch_centre_mm, _share(*by_patch), _share(*by_frame))


def _share(part: npt.ArrayLike, whole: npt.ArrayLike) -> FloatArray:
    counts = np.asarray(whole, dtype=float)
    return np.asarray(np.divide(part, counts, out=np.full(counts.shape, np.nan), where=counts > 0))


def _read_details(folder: Path) -> Record:
    """Read the sweep's summary as a mapping; empty where it is missing or cannot be read."""
    try:
        (summary,) = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["sweeps"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _open_sweep(directory: Path, entry: Record, found: Reconstruction, notes: list[str]) -> Sweep | None:
    stored = Path(str(entry["path"]))
    path = stored if stored.exists() else directory / stored
    missing = "so there is no reference in its curves and there are no reslices"
    if not path.exists():
        notes.append(f"The sweep is no longer at {stored}, {missing}.")
        return None
    try:
        if recording_sha256(path) != found.provenance.input_sha256:
            notes.append(f"The sweep at {stored} is no longer the one that was reconstructed, {missing}.")
            return None
        return apply_calibrations(load_sweep(path), [c.path for c in found.provenance.calibrations])[0]
    except Speckle3DError as error:
        notes.append(f"The sweep cannot be read ({error}), {missing}.")
        return None


@dataclass(frozen=True)
class Cut:
    """A reslice, its enlarged detail and where in the reslice that lies.

    Attributes
    ----------
    image, detail : ndarray of float32, shape (rows, columns)
        Grey levels 0 to 255, NaN where no frame reached.
    extent_mm : (width, height)
    corner_mm, size_mm : ndarray, shape (2,)
        Top left of the detail, along the sweep and in depth from the reslice's own top left, and its sides.
    """

    image: Float32Array
    extent_mm: tuple[float, float]
    detail: Float32Array
    corner_mm: FloatArray
    size_mm: FloatArray


@dataclass(frozen=True)
class Cuts:
    """The cuts of all modes, and one image of the sweep."""

    by_mode: dict[str, Cut]
    depth_mm: float
    middle: Float32Array
    grid: ImageGrid


def cut_modes(view: SweepView) -> Cuts | None:
    """Reslice the sweep at its middle vector in every mode; None where the sweep itself is gone.

    The detail shows the place of most contrast in the most trusted trajectory (the reference, else the last
    mode), and the same place of the same frame in all others.
    """
    if view.sweep is None:
        return None
    images = grey_images(view.sweep, _DYNAMIC_RANGE_DB, reconstruction=view.reconstruction)
    first, grid = middle_vectors(images.grid)
    left = RigidTransform.from_translation([first * grid.vector_pitch_mm, 0.0, 0.0])
    # The middle vectors, made once for all modes: a sweep of a thousand whole images need not fit in memory.
    chosen = slice(first, first + grid.vectors)
    strip = [np.rint(images[i][chosen]).astype(np.uint8) for i in range(len(view.sweep))]
    poses = {mode: each * left for mode, each in view.poses.items()}
    planes = middle_planes(poses, grid)
    whole = {mode: cut_frames(strip, grid, poses[mode], planes[mode]) for mode in poses}
    width_mm = min(DETAIL_MM, _DETAIL_SHARE * min(plane.width_mm for plane in planes.values()))
    size_mm = np.array([1.0, 0.8]) * max(width_mm, 10 * DETAIL_PIXEL_MM)
    last = list(planes)[-1]
    frame, depth_mm = _detail_place(poses[last], planes[last], whole[last], grid, size_mm)
    by_mode = {}
    for mode, plane in planes.items():
        point = np.array([grid.width_mm / 2, depth_mm, 0.0])
        centre = plane.world_from_plane.inv().apply(poses[mode][frame].apply(point))[:2]
        corner = centre - size_mm / 2
        placed = plane.world_from_plane * RigidTransform.from_translation([*corner, 0.0])
        window = ReslicePlane(placed, float(size_mm[0]), float(size_mm[1]), DETAIL_PIXEL_MM)
        detail = cut_frames(strip, grid, poses[mode], window)
        by_mode[mode] = Cut(whole[mode], (plane.width_mm, plane.height_mm), detail, corner, size_mm)
    return Cuts(by_mode, depth_mm, images[len(view.sweep) // 2], images.grid)


def _detail_place(
    poses: RigidTransform, plane: ReslicePlane, image: Float32Array, grid: ImageGrid, size_mm: FloatArray
) -> tuple[int, float]:
    """Frame and depth of the place with most contrast between its parts, speckle smoothed away."""
    seen = np.isfinite(image)
    if not seen.any():
        return len(poses) // 2, float(grid.centre_mm[1])
    # Where nothing was seen, the mean stands in, or the rim would have the greatest contrast.
    smooth = gaussian_filter(np.where(seen, image, image[seen].mean()), 0.4 / PIXEL_MM)
    size = [max(1, round(side / PIXEL_MM)) for side in size_mm[::-1]]
    spread = uniform_filter(smooth**2, size) - uniform_filter(smooth, size) ** 2
    # Only windows that lie wholly on images: the rim of the reslice has contrast but no content.
    inside = uniform_filter(seen.astype(float), size, mode="constant") > 0.999
    # The contrast of the near field is the probe's own.
    inside[: int((NEAR_FIELD_MM + size_mm[1] / 2) / PIXEL_MM)] = False
    if not inside.any():
        return len(poses) // 2, float(grid.centre_mm[1])
    row, column = np.unravel_index(int(np.argmax(np.where(inside, spread, -1.0))), image.shape)
    point = plane.world_from_plane.apply([column * PIXEL_MM, row * PIXEL_MM, 0.0])
    in_image = poses.inv().apply(point)
    frame = int(np.argmin(np.abs(in_image[:, 2])))
    return frame, float(np.clip(in_image[frame, 1], grid.first_sample_depth_mm, grid.depth_mm))
