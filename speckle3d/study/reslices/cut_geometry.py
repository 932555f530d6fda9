"""Where the cuts in a picture lie in the world, kept in the picture itself: a PNG's text under one keyword.

Whoever picks points in the picture, by its axes, gets points of the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.imaging.cuts.curved import CurvedSheet
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.io.hdf5 import reading
from speckle3d.study.reslices.places import AnyCut

KEYWORD = "speckle3d.reslice"

_SAME_POSE = 1e-6
"""Of the numbers of a matrix, mm: what writing and reading may change in it."""

Anchors = Mapping[int, FloatArray]
"""Poses of some frames by their numbers, matrices from image to world: they tell whose world a cut is in."""


@dataclass(frozen=True)
class PicturedCut:
    """One cut in a picture.

    Attributes
    ----------
    mode : str
        Whose poses place it in the world.
    cut : ReslicePlane or CurvedSheet
        Its `world_from_mm` takes what the picture's axes say.
    anchors : mapping of int to ndarray, shape (4, 4)
        Poses of some frames; none where no frames were cut.
    """

    mode: str
    cut: AnyCut
    anchors: Anchors = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """The cut as the picture's text holds it; `_pictured` reads it back."""
        cut = self.cut
        place: dict[str, Any]
        if isinstance(cut, CurvedSheet):
            place = {"kind": "curved", "base_mm": cut.base_mm.tolist(), "down": cut.down.tolist()}
        else:
            matrix = cut.world_from_plane.as_matrix().tolist()
            place = {"kind": "plane", "world_from_plane": matrix, "width_mm": cut.width_mm}
        sizes = {"height_mm": cut.height_mm, "pixel_mm": cut.pixel_mm, "first_mm": list(cut.first_mm)}
        anchors = {number: pose.tolist() for number, pose in self.anchors.items()}
        return {"mode": self.mode, **place, **sizes, "anchors": anchors}


def anchors_of(world_from_image: RigidTransform, numbers: IntArray | None = None) -> Anchors:
    """Poses of the first, the middle and the last frame, by their numbers, which count from 0 by default."""
    count = len(world_from_image)
    at = sorted({0, count // 2, count - 1})
    return {int(k if numbers is None else numbers[k]): world_from_image[k].as_matrix() for k in at}


def require_same_poses(
    shown: PicturedCut, world_from_image: RigidTransform, where: str, numbers: IntArray | None = None
) -> None:
    """Raise `InvalidInputError` if a picture was cut at other poses than these.

    Parameters
    ----------
    numbers : ndarray of int, shape (n,), optional
        Of the frames; by default they count from 0.
    """
    frames = range(len(world_from_image)) if numbers is None else numbers.tolist()
    there = dict(zip(frames, world_from_image.as_matrix(), strict=True))
    for number, pose in shown.anchors.items():
        if number not in there or np.abs(there[number] - pose).max() > _SAME_POSE:
            raise InvalidInputError(
                f"{where}: expected a picture of these poses of mode {shown.mode!r}, got one of another "
                f"reconstruction, whose frame {number} lies elsewhere: cut this one again (speckle3d reslice)"
            )


def read_cuts(path: PathLike) -> list[PicturedCut]:
    """Read which cuts a picture shows, and where they lie.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is no PNG of `speckle3d reslice`.
    """
    from PIL import Image, UnidentifiedImageError

    expected = f"{path}: expected a PNG that `speckle3d reslice` wrote"
    with reading(path), open_regular(path) as stream:
        try:
            text = dict(getattr(Image.open(stream, formats=["PNG"]), "text", {}))
        except (UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise InvalidInputError(f"{expected}, got something else") from error
    if KEYWORD not in text:
        raise InvalidInputError(f"{expected}, got another picture, or one whose text was left out")
    try:
        return [_pictured(each, f"{path}: {KEYWORD}") for each in json.loads(text[KEYWORD])["cuts"]]
    except Speckle3DError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise InvalidInputError(f"{expected}, got one whose text is damaged") from error


def read_plane(path: PathLike, mode: str | None = None) -> PicturedCut:
    """Read where the cut of one mode in a picture lies; of the first, unless one is named.

    Raises
    ------
    FileError, InvalidInputError
        As `read_cuts`, and if the picture does not show that mode.
    """
    cuts = {each.mode: each for each in read_cuts(path)}
    chosen = next(iter(cuts), None) if mode is None else mode
    if chosen not in cuts:
        raise InvalidInputError(f"{path}: expected a cut of mode {mode!r}, got {', '.join(cuts) or 'none'}")
    return cuts[chosen]


def _pictured(record: Any, where: str) -> PicturedCut:
    first_x, first_y = map(float, record["first_mm"])
    sizes = float(record["height_mm"]), float(record["pixel_mm"]), (first_x, first_y)
    cut: AnyCut
    if record["kind"] == "curved":
        base, down = (np.array(record[name], dtype=float) for name in ("base_mm", "down"))
        cut = CurvedSheet(base, down, *sizes)
    else:
        (placed,) = transforms_from_matrices([record["world_from_plane"]], where)
        cut = ReslicePlane(placed, float(record["width_mm"]), *sizes)
    anchors = record.get("anchors", {}).items()
    return PicturedCut(
        str(record["mode"]),
        cut,
        {int(number): np.array(pose, dtype=float).reshape(4, 4) for number, pose in anchors},
    )
