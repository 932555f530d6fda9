"""Similarity of two crossing sweeps and its derivatives by scale, rotation and place.

Points of either sweep's images are looked up in the other's. Both lists, without their mean and of unit
length, differ by a vector whose squared length is 2 (1 - correlation): the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.geometry import skew
from speckle3d.correction.crossing.planes import BENDS, StraightSweep
from speckle3d.correction.crossing.texture import gaussian_mean
from speckle3d.correction.curves import CorrectedChain
from speckle3d.kernels.crossing import look_up

RIGID = 6
PARAMETERS = RIGID + 2 * BENDS
"""A shift and turn of the second path against the first, then the bends of both."""


@dataclass(frozen=True)
class Placing:
    """Relative pose of two paths and the bends of both.

    Attributes
    ----------
    first_from_second : RigidTransform
        Between the paths' frames.
    bends : ndarray, shape (2, 12)
    """

    first_from_second: RigidTransform
    bends: FloatArray

    def moved_by(self, step: FloatArray) -> Placing:
        """Moved by a step: shift (mm) and turn (rad) in the first path's frame, then bends."""
        turn = RigidTransform.from_components(step[:3], Rotation.from_rotvec(step[3:RIGID]))
        return Placing(turn * self.first_from_second, self.bends + step[RIGID:].reshape(2, -1))

    def is_near(self, placing: Placing, apart_mm: float, apart_rad: float) -> bool:
        """Whether both differ by less than a shift and a turn."""
        first, second = self.first_from_second, placing.first_from_second
        near = np.linalg.norm(first.translation - second.translation) < apart_mm
        return bool(near and (first.rotation.inv() * second.rotation).magnitude() < apart_rad)


@dataclass(frozen=True)
class BlurredSweep:
    """A sweep at one blur, and the points of it that are looked up in the other.

    Attributes
    ----------
    volume : ndarray, shape (k, u, v)
    plane : ndarray, shape (n,)
        Of each point.
    local_mm : ndarray, shape (n, 3)
        Of each point in its plane.
    values : ndarray, shape (n,)
    """

    planes: CorrectedChain
    volume: Float32Array
    pixels: FloatArray
    plane: IntArray
    local_mm: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, sweep: StraightSweep, blur_mm: float, points: int) -> BlurredSweep:
        """Choose points at random."""
        volume = gaussian_mean(sweep.texture, blur_mm, sweep.spacing_mm)
        valid = np.flatnonzero(np.isfinite(volume))
        sample = np.random.default_rng(0).choice(valid, min(points, valid.size), replace=False)
        k, u, v = np.unravel_index(np.sort(sample), volume.shape)
        x, y = sweep.pixels[2] + u * sweep.pixels[0], sweep.pixels[3] + v * sweep.pixels[1]
        local = np.stack([x, y, np.zeros_like(x)], axis=1)
        return cls(sweep.planes, volume, sweep.pixels, k, local, volume[k, u, v].astype(float))


@dataclass(frozen=True)
class OneWay:
    """Points of one sweep looked up in the other.

    Attributes
    ----------
    values, levels : ndarray, shape (n,)
        Of the points, and what the other sweep shows there; NaN where it shows nothing.
    rows : ndarray, shape (n, 30)
        Change of `levels` with the parameters.
    points_mm : ndarray, shape (n, 3)
        In the first path's frame.
    """

    values: FloatArray
    levels: FloatArray
    rows: FloatArray
    points_mm: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Mask of the points that the other sweep shows."""
        return np.isfinite(self.levels)

    def residuals(self) -> tuple[FloatArray, FloatArray]:
        """Difference of both normalised lists at valid points, and its derivative."""
        valid = self.valid
        a, _ = _unit_vector(self.values[valid])
        b, size_b = _unit_vector(self.levels[valid])
        rows = self.rows[valid]
        rows = rows - rows.sum(axis=0) / max(len(rows), 1)
        return b - a, (rows - np.outer(b, b @ rows)) / size_b

    def correlation(self, points: BoolArray) -> float:
        """Correlation of both lists at some valid points; zero if there are too few."""
        if int(points.sum()) <= PARAMETERS:
            return 0.0
        return float(_unit_vector(self.values[points])[0] @ _unit_vector(self.levels[points])[0])


def look_up_points(pair: Sequence[BlurredSweep], placing: Placing) -> tuple[OneWay, OneWay]:
    """Look up either sweep's points in the other, all in the first path's frame."""
    planes, twists = [], []
    places = RigidTransform.identity(), placing.first_from_second
    for sweep, bends, place in zip(pair, placing.bends, places, strict=True):
        chain = sweep.planes.poses(bends)
        middle = len(chain) // 2
        into = place.as_matrix() @ np.linalg.inv(chain[middle])
        turn, shift = (into[:3, :3] @ (part - part[middle]) for part in sweep.planes.twists(bends, chain))
        planes.append(into @ chain)
        twists.append(np.concatenate([shift + skew(into[:3, 3]) @ turn, turn], axis=1))
    return _one_way(pair, planes, twists, 0), _one_way(pair, planes, twists, 1)


def _one_way(
    pair: Sequence[BlurredSweep], planes: Sequence[FloatArray], twists: Sequence[FloatArray], number: int
) -> OneWay:
    source, target = pair[number], pair[1 - number]
    poses = planes[number][source.plane]
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], source.local_mm) + poses[:, :3, 3]
    levels, place, slopes = np.empty(len(points)), np.empty(len(points)), np.empty((len(points), 3))
    from_first = np.ascontiguousarray(np.linalg.inv(planes[1 - number])[:, :3])
    look_up(points, target.volume, from_first, target.pixels, levels, slopes, place)
    valid = np.isfinite(levels)
    # What the level changes by as the point shifts and turns about the origin.
    pull = np.concatenate([slopes[valid], np.cross(points[valid], slopes[valid])], axis=1)
    rows = np.zeros((len(points), PARAMETERS))
    rows[valid, :RIGID] = pull if number == 1 else -pull
    for sweep, sign, plane in (
        (number, 1.0, source.plane[valid]),
        (1 - number, -1.0, np.round(place[valid]).astype(int)),
    ):
        block = slice(RIGID + sweep * BENDS, RIGID + (sweep + 1) * BENDS)
        rows[valid, block] = sign * np.einsum("ni,nij->nj", pull, twists[sweep][plane])
    return OneWay(source.values, levels, rows, points)


def _unit_vector(values: FloatArray) -> tuple[FloatArray, float]:
    away = values - values.sum() / max(values.size, 1)
    size = max(float(np.sqrt(away @ away)), 1e-12)
    return away / size, size
