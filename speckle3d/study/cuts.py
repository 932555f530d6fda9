"""Cuts through a sweep at the poses of one or several modes, as a person asks for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.curved import CurvedSheet, curved_sheet
from speckle3d.imaging.outlines import crossings, frame_outlines
from speckle3d.imaging.planes import (
    DEFAULT_PIXEL_MM,
    ReslicePlane,
    covering_box,
    covering_plane,
    depth_line,
    lateral_line,
    planes_from_first_frame,
    spanned_plane,
    three_point_plane,
    turned_frame_plane,
)
from speckle3d.imaging.reslice import reslice_frames, reslice_volume
from speckle3d.io.load import kind_of
from speckle3d.io.reconstructions import FORMAT
from speckle3d.scoring.references import REFERENCES, find_reference
from speckle3d.scoring.trajectories import poses_of
from speckle3d.study.posed import PosedSweep, open_posed, posed_by_itself

AnyCut = ReslicePlane | CurvedSheet

_SAME_DIRECTION = np.cos(np.deg2rad(20.0))
"""An axis goes by the name of a direction of the sweep within so much of it."""


@dataclass(frozen=True)
class Place:
    """Where to cut a sweep: one of these; with none, along the sweep at the middle of the image.

    Attributes
    ----------
    lateral_mm : float, optional
        Along the sweep and into the depth; with `frame`, where the axis lies about which the plane is turned.
    depth_mm : float, optional
        Along the sweep at one depth.
    frame : int, optional
        In a frame, turned out of it by `angle_deg` about its depth line: 90 is along the sweep.
    angle_deg : float
    points_mm : ndarray, shape (3, 3), optional
        Through three points of the world.
    origin_mm, right, down : ndarray, shape (3,), optional
        From a point of the world along two directions.
    curve_mm : ndarray, shape (n, 3), optional
        Along a curve through points of the world, and down into the depth, or along `down`.
    smooth : bool
        Join the curve's points by a spline.
    pixel_mm : float
    reach_mm : float
        Frames farther from a pixel do not count.
    """

    lateral_mm: float | None = None
    depth_mm: float | None = None
    frame: int | None = None
    angle_deg: float = 0.0
    points_mm: FloatArray | None = None
    origin_mm: FloatArray | None = None
    right: FloatArray | None = None
    down: FloatArray | None = None
    curve_mm: FloatArray | None = None
    smooth: bool = True
    pixel_mm: float = DEFAULT_PIXEL_MM
    reach_mm: float = 0.5

    def cuts(self, poses: Mapping[str, RigidTransform], grid: ImageGrid, reference: str) -> dict[str, AnyCut]:
        """Place the cut at the poses of every mode, by the frame it hangs on: the first or the one named.

        Points and directions are those of the reference's world.

        Raises
        ------
        InvalidInputError
            If the place is none, or not in the sweep.
        """
        line = self._line(grid)
        if line is not None:
            return dict(planes_from_first_frame(poses, line, self.pixel_mm))
        there = poses[reference]
        frame = 0 if self.frame is None else self.frame
        if not 0 <= frame < len(there):
            raise InvalidInputError(f"--frame: expected 0 to {len(there) - 1}, got {frame}")
        cut = self._in_world(grid, there)
        return {mode: _moved(cut, each[frame] * there[frame].inv()) for mode, each in poses.items()}

    def words(self, grid: ImageGrid) -> str:
        """Where the cut is."""
        if self.frame is not None:
            turned = f", turned {self.angle_deg:g}°" if self.angle_deg else ""
            return f"plane of frame {self.frame}{turned}"
        if self.points_mm is not None:
            return "plane through three points"
        if self.origin_mm is not None:
            return "plane from " + _words(self.origin_mm) + " mm"
        if self.curve_mm is not None:
            return f"along a curve through {len(self.curve_mm)} points"
        if self.depth_mm is not None:
            return f"at depth {self.depth_mm:g} mm"
        lateral = grid.width_mm / 2 if self.lateral_mm is None else self.lateral_mm
        return f"at lateral {lateral:.4g} mm"

    def cut_of_box(self, volume: Volume) -> AnyCut:
        """Place the cut in a volume, as large as it shows of that; by default the middle of i and j."""
        if self.lateral_mm is not None or self.depth_mm is not None or self.frame is not None:
            raise InvalidInputError(
                "expected --points, --origin or --curve for a volume, got a place in frames: it has none"
            )
        corners = np.array(list(product(*([0, n - 1] for n in volume.shape))), dtype=float)
        corners = corners @ volume.world_from_index[:3, :3].T + volume.world_from_index[:3, 3]
        if self.curve_mm is not None:
            down = self.down if self.down is not None else volume.world_from_index[:3, 1]
            return self._swept(down, corners)
        if self.points_mm is not None:
            placed = three_point_plane(self.points_mm)
        elif self.origin_mm is not None and self.right is not None and self.down is not None:
            placed = spanned_plane(self.origin_mm, self.right, self.down)
        else:
            middle = RigidTransform.from_translation([0, 0, (volume.shape[2] - 1) / 2 * volume.spacing_mm[2]])
            placed = volume.world_from_grid * middle
        return covering_box(placed, corners, self.pixel_mm)

    def _line(self, grid: ImageGrid) -> FloatArray | None:
        if self.depth_mm is not None:
            return depth_line(grid, self.depth_mm)
        if any(each is not None for each in (self.frame, self.points_mm, self.origin_mm, self.curve_mm)):
            return None
        return lateral_line(grid, grid.width_mm / 2 if self.lateral_mm is None else self.lateral_mm)

    def _in_world(self, grid: ImageGrid, there: RigidTransform) -> AnyCut:
        if self.curve_mm is not None:
            return self._sheet(grid, there)
        if self.frame is not None:
            lateral = grid.width_mm / 2 if self.lateral_mm is None else self.lateral_mm
            placed = turned_frame_plane(there[self.frame], lateral, self.angle_deg)
        elif self.points_mm is not None:
            placed = three_point_plane(self.points_mm)
        else:
            if self.origin_mm is None or self.right is None or self.down is None:
                raise InvalidInputError("plane: expected its origin and two directions")
            placed = spanned_plane(self.origin_mm, self.right, self.down)
        plane = covering_plane(placed, grid, there, self.reach_mm, self.pixel_mm)
        if self.frame is not None and not self.angle_deg:
            # In a frame itself x counts from the first vector.
            x, y = plane.first_mm
            plane = replace(plane, first_mm=(x + lateral, y))
        return plane

    def _sheet(self, grid: ImageGrid, there: RigidTransform) -> CurvedSheet:
        down = mean_directions(there)[1] if self.down is None else self.down
        return self._swept(down, frame_outlines(grid, there).reshape(-1, 3))

    def _swept(self, down: FloatArray, around_mm: FloatArray) -> CurvedSheet:
        """Sweep the curve as far along its columns as there is something."""
        points = np.asarray(self.curve_mm, dtype=float)
        top, bottom = 0.0, 1.0
        if len(points):
            along = (around_mm - points[0]) @ down / max(float(np.linalg.norm(down)), 1e-9)
            top, bottom = float(along.min()), float(along.max())
        return curved_sheet(points, down, (top, bottom), self.pixel_mm, self.smooth)


@dataclass(frozen=True)
class DrawnCut:
    """A cut as it is drawn.

    Attributes
    ----------
    image : ndarray of float32, shape (rows, columns)
        dB or levels; NaN where nothing was seen.
    cut : ReslicePlane or CurvedSheet
        Where it is.
    frames : ndarray, shape (n, 2, 2)
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
        Of the images: "dB" or "level".
    levels : tuple of float, optional
        Black and white.
    reference : str, optional
        Mode that the others are compared with.
    name : str
        Of the sweep or the volume.
    """

    cuts: Mapping[str, DrawnCut]
    axes: tuple[str, str] = ("along the sweep", "depth")
    place: str = ""
    unit: str = "dB"
    levels: tuple[float, float] | None = None
    reference: str | None = None
    name: str = ""


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
    path: Path, modes: Sequence[str] = (), reference: str | None = None, sweep_file: Path | None = None
) -> OpenedModes:
    """Open a reconstruction at several modes, or a recording at its own poses.

    Parameters
    ----------
    path : path
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
    known = [mode for mode in modes if mode not in REFERENCES]
    if kind_of(path) != FORMAT:
        known = list(modes)
    first = open_posed(path, known[0] if known else None, sweep_file)
    asked = list(dict.fromkeys(modes)) or [first.mode]
    own = find_reference(first.sweep) if len(asked) > 1 and reference is None else None
    if reference is None:
        reference = own.name if own is not None and own.covered.all() else asked[0]
    if reference not in asked:
        asked.append(reference)
    covered = np.zeros(len(first.sweep), dtype=bool)
    covered[first.frames] = True
    every: dict[str, tuple[RigidTransform, IntArray]] = {}
    for mode in asked:
        if mode == first.mode:
            every[mode] = first.world_from_image, first.frames
        elif first.reconstruction is not None and mode not in REFERENCES:
            every[mode] = poses_of(first.reconstruction, mode), first.frames
        else:
            itself = posed_by_itself(first.sweep, mode)
            every[mode] = itself.world_from_image, itself.frames
    shared = reduce(np.intersect1d, [frames for _, frames in every.values()])
    poses = {mode: each[np.isin(frames, shared)] for mode, (each, frames) in every.items()}
    posed = replace(first, frames=shared, world_from_image=poses[asked[0]], mode=asked[0])
    return OpenedModes(posed, poses, reference)


def cut_posed(
    opened: OpenedModes,
    place: Place,
    dynamic_range_db: float = 60.0,
    voxels: Volume | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CutPicture:
    """Cut a sweep at the poses of every mode, from its frames or from voxels made of it."""
    images, grid = opened.posed.images(dynamic_range_db, progress)
    placed = place.cuts(opened.poses, grid, opened.reference)
    cuts = {}
    for mode, cut in placed.items():
        poses = opened.poses[mode]
        if voxels is None:
            image = reslice_frames(images, grid, poses, cut, place.reach_mm)
            image = ((image / 255 - 1) * dynamic_range_db).astype(np.float32)
        else:
            image = reslice_volume(voxels, cut)
        cuts[mode] = DrawnCut(image, cut, frame_lines(cut, grid, poses))
    _require_seen(cuts, opened.poses[opened.reference], grid)
    axes = axis_names(placed[opened.reference], opened.poses[opened.reference])
    reference = opened.reference if len(cuts) > 1 else None
    unit, levels = ("dB", (-dynamic_range_db, 0.0)) if voxels is None else ("level", None)
    name = opened.posed.sweep.name
    return CutPicture(cuts, axes, place.words(grid), unit, levels, reference, name)


def cut_voxels(volume: Volume, place: Place, name: str = "") -> CutPicture:
    """Cut a volume; by default across the middle of its third axis."""
    cut = place.cut_of_box(volume)
    image = reslice_volume(volume, cut)
    return CutPicture({"volume": DrawnCut(image, cut)}, ("in the cut", "in the cut"), unit="level", name=name)


def _require_seen(cuts: Mapping[str, DrawnCut], poses: RigidTransform, grid: ImageGrid) -> None:
    if any(np.isfinite(each.image).any() for each in cuts.values()):
        return
    outlines = frame_outlines(grid, poses)
    low, high = outlines.min(axis=(0, 1)), outlines.max(axis=(0, 1))
    raise InvalidInputError(
        f"cut: expected one that meets the sweep, which lies between {_words(low)} and {_words(high)} mm, "
        "got one that shows nothing"
    )


def mean_directions(world_from_image: RigidTransform) -> FloatArray:
    """Mean lateral, axial and elevational direction of frames, shape (3, 3), a unit vector each."""
    axes = world_from_image.rotation.as_matrix().mean(axis=0).T
    return np.asarray(axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9))


def axis_names(cut: AnyCut, world_from_image: RigidTransform) -> tuple[str, str]:
    """Names of a cut's axes by the directions of the sweep that they follow."""
    if isinstance(cut, CurvedSheet):
        return "along the curve", _name(cut.down, world_from_image)
    right, down = cut.world_from_plane.rotation.as_matrix().T[:2]
    return _name(right, world_from_image), _name(down, world_from_image)


def frame_lines(cut: AnyCut, grid: ImageGrid, world_from_image: RigidTransform) -> FloatArray:
    """Lines in which frames cross a plane, by its axes, shape (n, 2, 2), mm; not on a sheet."""
    if isinstance(cut, CurvedSheet):
        return np.empty((0, 2, 2))
    found = crossings(frame_outlines(grid, world_from_image), cut.world_from_plane)
    return np.asarray(found + np.array(cut.first_mm))


def cut_as_volume(picture: CutPicture) -> Volume:
    """The only cut as a volume of one plane at its place: levels 1 to 255, and 0 where nothing was seen.

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
    low, high = picture.levels or (0.0, 255.0)
    # From 1 up, so that 0 means nothing was seen.
    level = 1 + np.rint(254 * np.clip((drawn.image - low) / (high - low), 0, 1))
    voxels = np.nan_to_num(level, nan=0.0).astype(np.uint8)
    fields = {"cut": picture.place, "of": picture.name, "mode": mode}
    if picture.unit == "dB":
        fields["levels"] = f"log-compressed, {high - low:g} dB from 1 to 255; 0 where nothing was seen"
    step = drawn.cut.pixel_mm
    return Volume(voxels[None].T, (step, step, step), drawn.cut.world_from_plane, fields)


def _moved(cut: AnyCut, move: RigidTransform) -> AnyCut:
    if isinstance(cut, CurvedSheet):
        return replace(cut, base_mm=move.apply(cut.base_mm), down=move.rotation.apply(cut.down))
    return replace(cut, world_from_plane=move * cut.world_from_plane)


def _name(direction: FloatArray, world_from_image: RigidTransform) -> str:
    names = ("lateral", "depth", "along the sweep")
    alike = mean_directions(world_from_image) @ direction
    best = int(np.argmax(np.abs(alike)))
    if abs(alike[best]) < _SAME_DIRECTION:
        return "in the plane"
    return names[best] if alike[best] > 0 else f"{names[best]}, backwards"


def _words(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{each:.4g}" for each in vector) + ")"
