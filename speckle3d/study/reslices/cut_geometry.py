"""Where the cuts in a picture lie in the world, kept in the picture itself: a PNG's text under one keyword.

Whoever picks points in the picture, by its axes or by its pixels, gets points of the world.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.imaging.cuts.curved import CurvedSheet
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.io.hdf5 import atomic_path, make_folder, reading
from speckle3d.study.figures import DOTS_PER_INCH

KEYWORD = "speckle3d.reslice"
VERSION = 1

_SAME_POSE = 1e-6
"""Of the numbers of a matrix, mm: what writing and reading may change in it."""

Box = tuple[float, float, float, float]
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
    boxes_px : sequence of tuple of float
        Left, top, right and bottom of every panel that shows it, in pixels of the picture from its top left.
    anchors : mapping of int to ndarray, shape (4, 4)
        Poses of some frames; none where no frames were cut.
    """

    mode: str
    cut: ReslicePlane | CurvedSheet
    boxes_px: Sequence[Box] = ()
    anchors: Anchors = field(default_factory=dict)

    def mm_from_px(self, points_px: npt.ArrayLike, panel: int = 0) -> FloatArray:
        """What the axes say at points of the picture, by column and row of its pixels: shape (n, 2), mm."""
        left, top, right, bottom = self.boxes_px[panel]
        x_left, x_right, y_bottom, y_top = self.cut.extent_mm
        share = (np.asarray(points_px, dtype=float) - [left, top]) / [right - left, bottom - top]
        return np.asarray([x_left, y_top] + share * [x_right - x_left, y_bottom - y_top])


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
        Of the frames, in ascending order; by default they count from 0.
    """
    frames = np.arange(len(world_from_image)) if numbers is None else numbers
    for number, pose in shown.anchors.items():
        at = np.flatnonzero(frames == number)
        is_there = at.size == 1
        if not (is_there and np.abs(world_from_image[int(at[0])].as_matrix() - pose).max() <= _SAME_POSE):
            raise InvalidInputError(
                f"{where}: expected a picture of these poses of mode {shown.mode!r}, got one of another "
                f"reconstruction, whose frame {number} lies elsewhere: cut this one again (speckle3d reslice)"
            )


def save_cuts(
    figure: Figure,
    path: Path,
    cuts: Mapping[str, ReslicePlane | CurvedSheet],
    panels: Mapping[str, Axes],
    words: Mapping[str, Any] | None = None,
    anchors: Mapping[str, Anchors] | None = None,
) -> Path:
    """Write a picture of cuts as a PNG that says where they lie; it appears whole or not at all.

    Parameters
    ----------
    figure : Figure
    path : path
    cuts : mapping of str to ReslicePlane or CurvedSheet
        By mode.
    panels : mapping of str to Axes
        The panel that shows each.
    words : mapping, optional
        What else to keep: names of axes, of the input.
    anchors : mapping of str to mapping, optional
        Poses of some frames of each mode, by `anchors_of`.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    make_folder(path.parent)
    figure.set_dpi(DOTS_PER_INCH)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    height = canvas.get_width_height()[1]
    records = [
        {
            "mode": mode,
            **_as_record(cut),
            "boxes_px": [_box(panels[mode], height)],
            "anchors": {number: pose.tolist() for number, pose in (anchors or {}).get(mode, {}).items()},
        }
        for mode, cut in cuts.items()
    ]
    record = json.dumps({"version": VERSION, **(words or {}), "cuts": records})
    with atomic_path(path) as part:
        drawn = np.asarray(canvas.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]
        imsave(part, drawn, format="png", dpi=DOTS_PER_INCH, metadata={KEYWORD: record},
               pil_kwargs={"compress_level": 3})  # fmt: skip
    return path


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
        record = json.loads(text[KEYWORD])
        return [_pictured(each, f"{path}: {KEYWORD}") for each in record["cuts"]]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, (FileError, InvalidInputError)):
            raise
        raise InvalidInputError(f"{expected}, got one whose text is damaged") from error


def read_plane(path: PathLike, mode: str | None = None) -> PicturedCut:
    """Read where the cut of one mode in a picture lies; of the first, unless one is named.

    Raises
    ------
    FileError, InvalidInputError
        As `read_cuts`, and if the picture does not show that mode.
    """
    cuts = read_cuts(path)
    wanted = [each for each in cuts if mode is None or each.mode == mode]
    if not wanted:
        shown = ", ".join(each.mode for each in cuts)
        raise InvalidInputError(f"{path}: expected a cut of mode {mode!r}, got {shown or 'none'}")
    return wanted[0]


def _box(axes: Axes, height_px: int) -> Box:
    box = axes.get_window_extent()
    return float(box.x0), float(height_px - box.y1), float(box.x1), float(height_px - box.y0)


def _as_record(cut: ReslicePlane | CurvedSheet) -> dict[str, Any]:
    shared = {"height_mm": cut.height_mm, "pixel_mm": cut.pixel_mm, "first_mm": list(cut.first_mm)}
    if isinstance(cut, CurvedSheet):
        return {"kind": "curved", "base_mm": cut.base_mm.tolist(), "down": cut.down.tolist(), **shared}
    matrix = cut.world_from_plane.as_matrix().tolist()
    return {"kind": "plane", "world_from_plane": matrix, "width_mm": cut.width_mm, **shared}


def _pictured(record: Any, where: str) -> PicturedCut:
    first_x, first_y = (float(each) for each in record["first_mm"])
    height, pixel = float(record["height_mm"]), float(record["pixel_mm"])
    cut: ReslicePlane | CurvedSheet
    if record["kind"] == "curved":
        base, down = np.array(record["base_mm"], dtype=float), np.array(record["down"], dtype=float)
        cut = CurvedSheet(base, down, height, pixel, (first_x, first_y))
    else:
        (placed,) = transforms_from_matrices([record["world_from_plane"]], where)
        cut = ReslicePlane(placed, float(record["width_mm"]), height, pixel, (first_x, first_y))
    boxes = [(float(a), float(b), float(c), float(d)) for a, b, c, d in record["boxes_px"]]
    anchors = {int(number): np.array(pose, dtype=float) for number, pose in record.get("anchors", {}).items()}
    if any(pose.shape != (4, 4) for pose in anchors.values()):
        raise ValueError("anchors: expected matrices of shape (4, 4)")
    return PicturedCut(str(record["mode"]), cut, boxes, anchors)
