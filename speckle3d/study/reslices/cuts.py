"""Cuts through a sweep at the poses of one or several modes, as a person asks for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.curved import CurvedSheet
from speckle3d.imaging.cuts.reslice import reslice_at, reslice_volume
from speckle3d.imaging.images import Images
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import kind_of
from speckle3d.io.reconstructions import FORMAT
from speckle3d.scoring.lengths import END_FRAMES, ModeError, accumulated, compare_modes
from speckle3d.scoring.references import REFERENCES, find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.posed import PosedSweep, open_posed, posed_by_itself
from speckle3d.study.reslices.cut_geometry import Anchors, anchors_of
from speckle3d.study.reslices.places import (
    AnyCut,
    Place,
    frame_centres,
    frame_lines,
    sweep_extent,
    view_of,
)


@dataclass(frozen=True)
class DrawnCut:
    """A cut as it is drawn.

    Attributes
    ----------
    image : ndarray of float32, shape (rows, columns)
        dB or levels; NaN where nothing was seen.
    cut : ReslicePlane or CurvedSheet
        Where it is.
    frames : ndarray, shape (n, m, 2)
        Line in which each frame crosses the cut, by the picture's axes, mm; NaN where it does not. Empty for
        cuts of voxels.
    centres : ndarray, shape (n,)
        Where along x the frames' centres are, from the first one's, mm.
    """

    image: Float32Array
    cut: AnyCut
    frames: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    centres: FloatArray = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of_sweep(cls, image: Float32Array, cut: AnyCut, grid: ImageGrid, poses: RigidTransform) -> DrawnCut:
        """A cut with where the frames are that it was made from."""
        return cls(image, cut, frame_lines(cut, grid, poses), frame_centres(cut, grid, poses))


@dataclass(frozen=True)
class CutPicture:
    """Cuts of one place at the poses of several modes, and what a picture of them says.

    Attributes
    ----------
    cuts : mapping of str to DrawnCut
        By mode.
    axes : tuple of str
        Names of x and y, without the unit.
    place : str
        Where the cut is.
    unit : str
        Of the images: dB below the maximum, or "level", and of what.
    levels : tuple of float, optional
        Black and white.
    name : str
        Of the sweep or the volume.
    numbers : ndarray of int, shape (n,), optional
        Of the frames; by default from 0.
    anchors : mapping of str to mapping
        Poses of some frames of each mode; see `cut_geometry.anchors_of`.
    lengths : mapping of str to str
        How long each mode is, in words.
    """

    cuts: Mapping[str, DrawnCut]
    axes: tuple[str, str] = ("along the sweep", "depth")
    place: str = ""
    unit: str = "dB, 0: maximum"
    levels: tuple[float, float] | None = None
    name: str = ""
    numbers: IntArray | None = None
    anchors: Mapping[str, Anchors] = field(default_factory=dict)
    lengths: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class OpenedModes:
    """A sweep at the poses of several modes.

    Attributes
    ----------
    posed : PosedSweep
        Of the frames that all modes have.
    poses : dict of str to RigidTransform, length n
    reference : str
        One of the modes.
    """

    posed: PosedSweep
    poses: dict[str, RigidTransform]
    reference: str


def open_modes(
    path: Path,
    modes: Sequence[str] = (),
    reference: str | None = None,
    sweep_file: Path | None = None,
    settings: ImportSettings | None = None,
    calibrations: Sequence[PathLike] = (),
    dynamic_range_db: float | None = None,
) -> OpenedModes:
    """Open a reconstruction at several modes, or a recording at its own poses.

    Parameters
    ----------
    path, sweep_file, settings, calibrations, dynamic_range_db
        As for `open_posed`.
    modes : sequence of str
        Modes of the reconstruction, "tracker" or "truth"; by default as for `open_posed`.
    reference : str, optional
        What to compare them with; by default the truth or a tracker that covers all frames, if there are
        several modes, else the first.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If there is no such mode.
    """
    is_reconstruction = kind_of(path) == FORMAT
    own = [mode for mode in modes if mode not in REFERENCES or not is_reconstruction]
    others = sweep_file, settings, calibrations, dynamic_range_db
    first = open_posed(path, own[0] if own else None, *others)
    return at_modes(first, modes, reference)


def at_modes(first: PosedSweep, modes: Sequence[str] = (), reference: str | None = None) -> OpenedModes:
    """Take an opened sweep at several modes; as for `open_modes`."""
    asked = list(dict.fromkeys(modes)) or [first.mode]
    reference = reference or _known_reference(first.sweep, asked)
    every = {mode: _posed(first, mode) for mode in dict.fromkeys([*asked, reference])}
    shared = reduce(np.intersect1d, [frames for _, frames in every.values()])
    if not shared.size:
        raise InsufficientDataError(
            f"{first.sweep.name}: expected a frame that has a pose in {' and '.join(every)}, got none"
        )
    poses = {mode: each[np.isin(frames, shared)] for mode, (each, frames) in every.items()}
    posed = replace(first, frames=shared, world_from_image=poses[asked[0]], mode=asked[0])
    return OpenedModes(posed, poses, reference)


def _known_reference(sweep: Sweep, asked: Sequence[str]) -> str:
    """What several modes are compared with, if nobody says."""
    reference = find_reference(sweep) if len(asked) > 1 else None
    return reference.name if reference is not None and reference.covered.all() else asked[0]


def _posed(first: PosedSweep, mode: str) -> tuple[RigidTransform, IntArray]:
    """Poses of one mode, and the frames that have them."""
    if mode == first.mode:
        return first.world_from_image, first.frames
    if first.reconstruction is not None and mode not in REFERENCES:
        return poses_of(first.reconstruction, mode), first.frames
    itself = posed_by_itself(first.sweep, mode)
    return itself.world_from_image, itself.frames


def cut_posed(
    opened: OpenedModes,
    place: Place,
    dynamic_range_db: float = RANGE_DB,
    voxels: tuple[Volume, ByteArray | None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    made: tuple[Images, ImageGrid] | None = None,
) -> CutPicture:
    """Cut a sweep at the poses of every mode, from its frames or from voxels made of it and their states.

    Parameters
    ----------
    opened : OpenedModes
    place : Place
    dynamic_range_db : float
    voxels : tuple of Volume and ndarray or None, optional
    progress : callable, optional
        Called with the number of images made and of all.
    made : tuple of Images and ImageGrid, optional
        What `opened.posed.images` gives, by those who have it.

    Raises
    ------
    InvalidInputError
        If the place is incomplete, or shows nothing; says where the sweep is.
    """
    images, grid = made or opened.posed.images(dynamic_range_db, progress)
    numbers = opened.posed.frames
    placed = place.counted_in(numbers).cuts(opened.poses, grid, opened.reference)
    if voxels is None:
        pairs = [(opened.poses[mode], cut) for mode, cut in placed.items()]
        levels = reslice_at(images, grid, pairs, place.reach_mm)
        # B-mode that does not say its range stays in grey levels.
        step_db = dynamic_range_db / 255 if opened.posed.range_is_known else 1.0
        white = 255 if opened.posed.range_is_known else 0
        images_of_modes = [((each - white) * step_db).astype(np.float32) for each in levels]
    else:
        images_of_modes = [reslice_volume(voxels[0], cut, voxels[1]) for cut in placed.values()]
    there = opened.poses[opened.reference]
    if not any(np.isfinite(each).any() for each in images_of_modes):
        raise InvalidInputError(
            f"cut: expected one that meets the sweep, which lies {sweep_extent(there, grid)}, got one that "
            "shows nothing"
        )
    cuts = {
        mode: DrawnCut.of_sweep(image, cut, grid, opened.poses[mode])
        for (mode, cut), image in zip(placed.items(), images_of_modes, strict=True)
    }
    shown = placed[opened.reference]
    where = ", ".join(filter(None, [place.words(grid), view_of(shown, there)]))
    unit, limits = ("dB, 0: maximum", (-dynamic_range_db, 0.0))
    if not opened.posed.range_is_known:
        unit, limits = "level", (0.0, 255.0)
    return CutPicture(
        cuts,
        place.axes(shown, there),
        where,
        unit if voxels is None else _unit_of(voxels[0]),
        limits if voxels is None else None,
        opened.posed.sweep.name,
        numbers,
        {mode: anchors_of(poses, numbers) for mode, poses in opened.poses.items()},
        length_words(_rows(opened, grid.centre_mm), opened.reference),
    )


def length_words(rows: Sequence[ModeError], reference: str) -> dict[str, str]:
    """How long each mode is by its rows, and how far from the reference; of all parts of the sweep."""
    words: dict[str, list[str]] = {}
    for row in rows:
        percent = "" if np.isnan(row.length_error_percent) else f" {row.length_error_percent:+.1f} %"
        words.setdefault(row.mode, []).append(f"{row.estimate_mm:.2f} mm{percent}")
        if row.mode == rows[0].mode and np.isfinite(row.reference_mm):
            words.setdefault(reference, []).append(f"{row.reference_mm:.2f} mm")
    return {mode: ", ".join(each) for mode, each in words.items()}


def _rows(opened: OpenedModes, centre_mm: FloatArray) -> list[ModeError]:
    """Lengths of the modes, against the reference if that is one."""
    others = {mode: each for mode, each in opened.poses.items() if mode != opened.reference}
    there = opened.poses[opened.reference]
    if len(there) < 2:
        return []
    if not others:
        length_mm = float(accumulated(there, centre_mm).length_mm[-1])
        return [ModeError.of_estimate("all", opened.reference, len(there), length_mm)]
    return compare_modes(
        others, there, centre_mm, end_frames=END_FRAMES if opened.reference == "tracker" else 1
    )


def cut_voxels(volume: Volume, place: Place, name: str = "", state: ByteArray | None = None) -> CutPicture:
    """Cut a volume; by default across the middle of its third axis.

    Raises
    ------
    InvalidInputError
        If the place is incomplete, or misses the volume.
    """
    cut = place.cut_of_box(volume)
    drawn = DrawnCut(reslice_volume(volume, cut, state), cut)
    names = ("i", "j") if place.is_along_sweep else ("in the cut", "in the cut")
    return CutPicture({"volume": drawn}, names, place.words(), _unit_of(volume), name=name)


def _unit_of(volume: Volume) -> str:
    """What a volume's levels are, as far as its file says."""
    levels = volume.fields.get("levels", "")
    return f"level, {levels}" if levels else "level"


def cut_as_volume(picture: CutPicture) -> Volume:
    """The only cut as a volume of one plane at its place.

    Of frames, levels are 1 to 255, and 0 where nothing was seen; of voxels they stay as they are, NaN there.

    Raises
    ------
    InvalidInputError
        If there are several, or it is curved.
    """
    if len(picture.cuts) > 1:
        raise InvalidInputError(f"expected one mode for a volume file, got {', '.join(picture.cuts)}")
    ((mode, drawn),) = picture.cuts.items()
    if isinstance(drawn.cut, CurvedSheet):
        raise InvalidInputError("expected a picture (.png) of a curved cut, which lies in no one plane")
    fields = {"cut": picture.place, "of": picture.name, "mode": mode}
    voxels: npt.NDArray[Any] = drawn.image
    if picture.levels is not None:
        low, high = picture.levels
        # From 1 up, so that 0 means nothing was seen.
        level = 1 + np.rint(254 * np.clip((drawn.image - low) / (high - low), 0, 1))
        voxels = np.nan_to_num(level, nan=0.0).astype(np.uint8)
        what = f"log-compressed, {high - low:g} dB" if high == 0 else "grey levels of the B-mode"
        fields["levels"] = f"{what} from 1 to 255; 0 where nothing was seen"
    step = drawn.cut.pixel_mm
    return Volume(voxels[None].T, (step, step, step), drawn.cut.world_from_plane, fields)
