"""Cuts through a sweep at the poses of one or several modes, as a person asks for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.region import Region
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.curved import CurvedSheet
from speckle3d.imaging.cuts.reslice import reslice_at, reslice_volume
from speckle3d.imaging.images import Images
from speckle3d.scoring.lengths import ModeError
from speckle3d.scoring.references import Reference, error_rows, find_reference
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.posed import PosedSweep, posed_at
from speckle3d.study.reslices.cut_geometry import Anchors, anchors_of
from speckle3d.study.reslices.places import (
    AnyCut,
    Place,
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
    """

    image: Float32Array
    cut: AnyCut
    frames: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))


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


def at_modes(first: PosedSweep, modes: Sequence[str] = (), reference: str | None = None) -> OpenedModes:
    """Take an opened sweep at several modes.

    Parameters
    ----------
    first : PosedSweep
    modes : sequence of str
        Modes of the reconstruction, "tracker" or "truth"; by default the one it is opened at.
    reference : str, optional
        What to compare them with; by default the truth or a tracker that covers all frames, if there are
        several modes, else the first.

    Raises
    ------
    InvalidInputError, InsufficientDataError
        If there is no such mode.
    """
    asked = list(dict.fromkeys(modes)) or [first.mode]
    if reference is None:
        known = find_reference(first.sweep) if len(asked) > 1 else None
        reference = asked[0] if known is None or not known.covered.all() else known.name
    every = {
        mode: posed_at(first.sweep, mode, first.reconstruction) for mode in dict.fromkeys([*asked, reference])
    }
    shared = reduce(np.intersect1d, [each.frames for each in every.values()])
    if not shared.size:
        raise InsufficientDataError(
            f"{first.sweep.name}: expected a frame that has a pose in {' and '.join(every)}, got none"
        )
    poses = {mode: each.world_from_image[np.isin(each.frames, shared)] for mode, each in every.items()}
    posed = replace(first, frames=shared, world_from_image=poses[asked[0]], mode=asked[0])
    return OpenedModes(posed, poses, reference)


def cut_posed(
    opened: OpenedModes,
    place: Place,
    dynamic_range_db: float = RANGE_DB,
    voxels: tuple[Volume, ByteArray | None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    made: tuple[Images, ImageGrid] | None = None,
    region: Region | None = None,
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
    region : Region, optional
        Of the images; samples outside it do not count.

    Raises
    ------
    InvalidInputError
        If the place is incomplete, or shows nothing; says where the sweep is.
    """
    images, grid = made or opened.posed.images(dynamic_range_db, progress)
    poses, numbers = opened.poses, opened.posed.frames
    placed = place.counted_in(numbers).cuts(poses, grid, opened.reference)
    unit, limits = "dB, 0: maximum", (-dynamic_range_db, 0.0)
    if voxels is None:
        mask = None if region is None else region.mask(grid)
        wanted = [(poses[mode], placed[mode]) for mode in placed]
        levels = reslice_at(images, grid, wanted, place.reach_mm, mask)
        if opened.posed.range_is_known:
            levels = [((each - 255) * (dynamic_range_db / 255)).astype(np.float32) for each in levels]
        else:
            unit, limits = "level", (0.0, getattr(opened.posed.sweep.signal, "full_scale", 255.0))
    else:
        levels = [reslice_volume(voxels[0], cut, voxels[1]) for cut in placed.values()]
    there = poses[opened.reference]
    if not any(np.isfinite(each).any() for each in levels):
        raise InvalidInputError(
            f"cut: expected one that meets the sweep, which lies {sweep_extent(there, grid)}, got one that "
            "shows nothing"
        )
    shown = placed[opened.reference]
    lengths = error_rows(poses, Reference.over_all(opened.reference, there), grid.centre_mm)
    return CutPicture(
        drawn_cuts(dict(zip(placed, levels, strict=True)), placed, grid, poses),
        place.axes(shown, there),
        ", ".join(filter(None, [place.words(grid), view_of(shown, there)])),
        unit if voxels is None else _unit_of(voxels[0]),
        limits if voxels is None else None,
        opened.posed.sweep.name,
        {mode: anchors_of(each, numbers) for mode, each in poses.items()},
        length_words(lengths, opened.reference),
    )


def drawn_cuts(
    images: Mapping[str, Float32Array],
    cuts: Mapping[str, AnyCut],
    grid: ImageGrid,
    poses: Mapping[str, RigidTransform],
) -> dict[str, DrawnCut]:
    """Cuts by mode with where the frames are that they were made from."""
    return {
        mode: DrawnCut(
            image,
            cuts[mode],
            frame_lines(cuts[mode], grid, poses[mode]),
        )
        for mode, image in images.items()
    }


def length_words(rows: Sequence[ModeError], reference: str) -> dict[str, str]:
    """How long each mode is by its rows, and how far from the reference; of all parts of the sweep."""
    words: dict[str, list[str]] = {}
    for row in rows:
        percent = "" if np.isnan(row.length_error_percent) else f" {row.length_error_percent:+.1f} %"
        words.setdefault(row.mode, []).append(f"{row.estimate_mm:.2f} mm{percent}")
    parts = {row.part: row.reference_mm for row in rows if np.isfinite(row.reference_mm)}
    if reference not in words:
        words[reference] = [f"{length_mm:.2f} mm" for length_mm in parts.values()]
    return {mode: ", ".join(each) for mode, each in words.items()}


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
        level = 1 + np.rint(254 * np.clip((drawn.image - low) / (high - low), 0, 1))
        voxels = np.nan_to_num(level, nan=0.0).astype(np.uint8)
        what = f"log-compressed, {high - low:g} dB" if high == 0 else "grey levels of the B-mode"
        fields["levels"] = f"{what} from 1 to 255; 0 where nothing was seen"
    spacing = (drawn.cut.pixel_mm,) * 3
    return Volume(voxels[None].T, spacing, drawn.cut.world_from_plane, fields)
