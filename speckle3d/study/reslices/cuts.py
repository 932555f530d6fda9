"""Cuts through a sweep at the poses of several modes; where they lie stands in a PNG's text.

Whoever picks points in the picture, by its axes, gets points of the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.grid import Region
from speckle3d.core.sweep import BModeSettings
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines, within_fan
from speckle3d.imaging.cuts.planes import Cut
from speckle3d.imaging.cuts.reslice import reslice_at
from speckle3d.imaging.images import PosedImages
from speckle3d.io.hdf5 import reading
from speckle3d.scoring.lengths import ModeError
from speckle3d.scoring.references import Reference, error_rows
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.posed import SweepModes
from speckle3d.study.reslices.places import Place


@dataclass(frozen=True)
class DrawnCut:
    """A cut with its image and the frames' lines on it.

    Attributes
    ----------
    image : ndarray of float32, shape (rows, columns)
        dB or levels; NaN where nothing was seen.
    cut : Cut
        Where it is.
    frames : ndarray, shape (n, m, 2)
        Line in which each frame crosses the cut, by the picture's axes, mm; NaN where it does not. Empty for
        cuts of voxels.
    """

    image: Float32Array
    cut: Cut
    frames: FloatArray


@dataclass(frozen=True)
class CutPicture:
    """Cuts of one place at the poses of several modes, with the picture's text.

    Attributes
    ----------
    cuts : mapping of str to DrawnCut
        By mode.
    axes : tuple of str
        Names of x and y, without the unit.
    place : str
        Where the cut is.
    unit : str
        Of the images: dB below the maximum, or the grey level of B-mode.
    levels : tuple of float
        Black and white.
    name : str
        Of the sweep.
    marks : mapping of str to str
        Of the poses of each mode, by `pose_mark`.
    lengths : mapping of str to str
        Length of each mode, in words.
    """

    cuts: Mapping[str, DrawnCut]
    axes: tuple[str, str] = ("along the sweep", "depth")
    place: str = ""
    unit: str = "dB, 0: maximum"
    levels: tuple[float, float] = (-RANGE_DB, 0.0)
    name: str = ""
    marks: Mapping[str, str] = field(default_factory=dict)
    lengths: Mapping[str, str] = field(default_factory=dict)


def cut_at_modes(
    modes: SweepModes,
    place: Place,
    source: PosedImages,
    dynamic_range_db: float = RANGE_DB,
    region: Region | None = None,
) -> CutPicture:
    """Cut a sweep at the poses of every mode, straight from its frames.

    Parameters
    ----------
    modes : SweepModes
    place : Place
        Of these modes.
    source : PosedImages
        As `modes.posed.source` gives them: B-mode as stored, echoes log-compressed.
    dynamic_range_db : float
        Of the images of echoes.
    region : Region, optional
        Of the images; samples outside it do not count.

    Raises
    ------
    InvalidInputError
        If the cut shows nothing.
    """
    poses, grid, signal = modes.poses, source.grid, modes.posed.sweep.signal
    mask = None if region is None else region.mask(grid)
    cuts_at = [(poses[mode], cut) for mode, cut in place.cuts.items()]
    levels = reslice_at(source.images, grid, cuts_at, modes.reach_mm, mask)
    if isinstance(signal, BModeSettings):
        unit, limits = "grey level", (0.0, float(signal.full_scale))
    else:
        unit, limits = "dB, 0: maximum", (-dynamic_range_db, 0.0)
        levels = [((image - 255) * (dynamic_range_db / 255)).astype(np.float32) for image in levels]
    if not any(np.isfinite(image).any() for image in levels):
        raise InvalidInputError("cut: expected one that meets the sweep, got one that shows nothing")
    cuts = {}
    for (mode, cut), image in zip(place.cuts.items(), levels, strict=True):
        lines = np.empty((0, 2, 2))
        if cut.world_from_picture is not None:
            plane_from_image = cut.world_from_picture.inv() * poses[mode]
            lines = crossings(frame_outlines(grid, poses[mode]), cut.world_from_picture)
            lines = within_fan(lines, plane_from_image, modes.posed.sweep.grid)
        cuts[mode] = DrawnCut(image, cut, lines)
    reference = Reference.over_all(modes.reference, poses[modes.reference])
    lengths = length_words(error_rows(poses, reference, grid.centre_mm), modes.reference)
    name = modes.posed.sweep.name
    return CutPicture(cuts, place.axes, place.words, unit, limits, name, modes.marks, lengths)


def length_words(rows: Sequence[ModeError], reference: str) -> dict[str, str]:
    """Length of each mode and its error in per cent, a line for each part."""
    words: dict[str, dict[str, str]] = {}
    for row in rows:
        percent = "" if np.isnan(row.length_error_percent) else f" {row.length_error_percent:+.1f} %"
        words.setdefault(row.mode, {})[row.part] = f"{row.estimate_mm:.2f} mm{percent}"
    for row in rows:
        if np.isfinite(row.reference_mm):
            words.setdefault(reference, {}).setdefault(row.part, f"{row.reference_mm:.2f} mm")
    return {mode: "\n".join(parts.values()) for mode, parts in words.items()}


def cut_as_volume(picture: CutPicture) -> Volume:
    """The only cut as a volume of one plane at its place: levels 1 to 255, and 0 where nothing was seen.

    Raises
    ------
    InvalidInputError
        If there are several, or it is curved.
    """
    if len(picture.cuts) > 1:
        raise InvalidInputError(f"expected one mode for a volume file, got {', '.join(picture.cuts)}")
    ((mode, panel),) = picture.cuts.items()
    if panel.cut.world_from_picture is None:
        raise InvalidInputError("expected a picture (.png) of a curved cut, which lies in no one plane")
    low, high = picture.levels
    level = 1 + np.rint(254 * np.clip((panel.image - low) / (high - low), 0, 1))
    fields = {"cut": picture.place, "of": picture.name, "mode": mode}
    unit = picture.unit.partition(",")[0]
    fields["levels"] = f"1 to 255: {low:g} to {high:g} {unit}; 0 where nothing was seen"
    voxels = np.nan_to_num(level, nan=0.0).astype(np.uint8)
    place = RigidTransform.from_components(panel.cut.base_mm[0], panel.cut.world_from_picture.rotation)
    return Volume(voxels[None].T, (panel.cut.pixel_mm,) * 3, place, fields)


KEYWORD = "speckle3d.reslice"


@dataclass(frozen=True)
class PicturedPlane:
    """A plane in a picture.

    Attributes
    ----------
    mode : str
        Whose poses place it in the world.
    mark : str
        Of these poses, by `pose_mark`; empty where no frames were cut, and in older pictures.
    world_from_picture : RigidTransform
        From what the picture's axes say, x, y and 0, mm.
    """

    mode: str
    mark: str
    world_from_picture: RigidTransform

    def world_mm(self, picked_mm: FloatArray) -> FloatArray:
        """Points of the world, shape (n, 3), by the picture's axes, shape (n, 2)."""
        return self.world_from_picture.apply(np.column_stack([picked_mm, np.zeros(len(picked_mm))]))


def picture_text(cuts: Mapping[str, Cut], marks: Mapping[str, str]) -> str:
    """Text of the planes of a picture by mode, read back by `read_plane`; none of curved sheets."""
    planes = [
        {"mode": mode, "kind": "plane", "mark": marks.get(mode, ""), "first_mm": (0.0, 0.0)}
        | {"world_from_plane": cut.world_from_picture.as_matrix().tolist()}
        for mode, cut in cuts.items()
        if cut.world_from_picture is not None
    ]
    return json.dumps({"version": 1, "cuts": planes})


def read_plane(path: PathLike, mode: str | None = None) -> PicturedPlane:
    """Read where the plane of one mode in a picture lies; of the first, unless one is named.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is no PNG of `speckle3d reslice`, or does not show a plane of that mode.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with reading(path), open_regular(path) as stream:
            try:
                text = dict(getattr(Image.open(stream, formats=["PNG"]), "text", {}))
            except UnidentifiedImageError:  # an OSError, but not of the disk
                text = {}
        cuts = json.loads(text[KEYWORD])["cuts"]
        planes = [_plane(cut) for cut in cuts if cut["kind"] == "plane"]
    except (SyntaxError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"{path}: expected a PNG that `speckle3d reslice` wrote, got another or a damaged one"
        ) from error
    for plane in planes:
        if mode in (None, plane.mode):
            return plane
    modes = ", ".join(plane.mode for plane in planes) or "none"
    raise InvalidInputError(f"{path}: expected a plane of mode {mode!r}, got {modes}")


def _plane(record: Any) -> PicturedPlane:
    (world_from_plane,) = transforms_from_matrices([record["world_from_plane"]], KEYWORD)
    plane_from_picture = RigidTransform.from_translation([*np.negative(record["first_mm"]), 0.0])
    mark = str(record.get("mark", ""))
    return PicturedPlane(str(record["mode"]), mark, world_from_plane * plane_from_picture)
