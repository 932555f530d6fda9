"""Geometry of the cuts in a picture, stored in the PNG's text.

Whoever picks points in the picture, by its axes, gets points of the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.imaging.cuts.planes import Cut
from speckle3d.io.hdf5 import reading

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
