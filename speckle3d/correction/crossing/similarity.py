"""How alike two sweeps look where they cross, and how that changes with scales, turns and place.

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
from speckle3d.correction.crossing.path import BENDS, Path, StraightSweep
from speckle3d.kernels.crossing import look_up

RIGID = 6
PARAMETERS = RIGID + 2 * len(BENDS)
"""A turn and shift of the second path against the first, then the bends of both."""

_LEAST_POINTS = 200


@dataclass(frozen=True)
class Placing:
    """Where two paths lie against each other, and how both are bent.

    Attributes
    ----------
    first_from_second : RigidTransform
        Between the paths' frames.
    bends : ndarray, shape (2, 7)
    """

    first_from_second: RigidTransform
    bends: FloatArray

    def stepped(self, step: FloatArray) -> Placing:
        """Moved by a step: shift (mm) and turn (rad) in the first path's frame, then bends."""
        turn = RigidTransform.from_components(step[:3], Rotation.from_rotvec(step[3:RIGID]))
        return Placing(turn * self.first_from_second, self.bends + step[RIGID:].reshape(2, -1))


@dataclass(frozen=True)
class Textured:
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

    path: Path
    volume: Float32Array
    pixels: FloatArray
    plane: IntArray
    local_mm: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, sweep: StraightSweep, volume: Float32Array, points: int) -> Textured:
        """Choose about so many points evenly."""
        spacing = sweep.spacing_mm
        there = np.isfinite(volume)
        apart = (spacing.prod() * max(int(there.sum()), 1) / points) ** (1 / 3)
        strides = np.maximum(1, np.round(apart / spacing).astype(int))
        chosen = np.zeros_like(there)
        chosen[tuple(slice(s // 2, None, s) for s in strides)] = True
        k, u, v = np.nonzero(chosen & there)
        x, y = sweep.pixels[2] + u * sweep.pixels[0], sweep.pixels[3] + v * sweep.pixels[1]
        local = np.stack([x, y, np.zeros_like(x)], axis=1)
        return cls(sweep.path, volume, sweep.pixels, k, local, volume[k, u, v].astype(float))


@dataclass(frozen=True)
class OneWay:
    """Points of one sweep looked up in the other.

    Attributes
    ----------
    values, found : ndarray, shape (n,)
        Of the points, and what the other sweep shows there; NaN where it shows nothing.
    rows : ndarray, shape (n, 20)
        Change of `found` with the parameters.
    points_mm : ndarray, shape (n, 3)
        In the first path's frame.
    """

    values: FloatArray
    found: FloatArray
    rows: FloatArray
    points_mm: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Which points the other sweep shows."""
        return np.isfinite(self.found)

    def residuals(self, chosen: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Difference of both normalised lists at some points, and its derivative."""
        a, _ = _normalised(self.values[chosen])
        b, size_b = _normalised(self.found[chosen])
        rows = self.rows[chosen]
        rows = rows - rows.mean(axis=0)
        rows = (rows - np.outer(b, b @ rows)) / size_b
        return b - a, rows

    def correlation(self, chosen: BoolArray) -> float:
        """Of both lists at some points; zero if there are too few."""
        if int(chosen.sum()) < _LEAST_POINTS:
            return 0.0
        return float(_normalised(self.values[chosen])[0] @ _normalised(self.found[chosen])[0])


def compared(pair: Sequence[Textured], placing: Placing) -> tuple[OneWay, OneWay]:
    """Look up either sweep's points in the other, all in the first path's frame."""
    planes, twists = [], []
    into_first = (RigidTransform.identity(), placing.first_from_second)
    for sweep, bends, into in zip(pair, placing.bends, into_first, strict=True):
        bent = sweep.path.bent(bends)
        planes.append(into.as_matrix() @ bent)
        twists.append(_carrying(into) @ sweep.path.twists(bends, bent))
    return _looked_up(pair, planes, twists, 0), _looked_up(pair, planes, twists, 1)


def _carrying(into: RigidTransform) -> FloatArray:
    """Matrix that takes (shift, turn) of one frame into another, shape (6, 6)."""
    rotation = into.rotation.as_matrix()
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = rotation
    carried[:3, 3:] = skew(into.translation) @ rotation
    return carried


def _looked_up(
    pair: Sequence[Textured], planes: Sequence[FloatArray], twists: Sequence[FloatArray], which: int
) -> OneWay:
    ours, other = pair[which], pair[1 - which]
    poses = planes[which][ours.plane]
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], ours.local_mm) + poses[:, :3, 3]
    found, place, slopes = np.empty(len(points)), np.empty(len(points)), np.empty((len(points), 3))
    from_first = np.ascontiguousarray(np.linalg.inv(planes[1 - which])[:, :3])
    look_up(points, other.volume, from_first, other.pixels, found, slopes, place)
    valid = np.isfinite(found)
    # What the level found changes by as the point shifts and turns about the origin.
    pull = np.concatenate([slopes[valid], np.cross(points[valid], slopes[valid])], axis=1)
    near = np.round(place[valid]).astype(int)
    columns = [slice(RIGID + k * len(BENDS), RIGID + (k + 1) * len(BENDS)) for k in (0, 1)]
    rows = np.zeros((len(points), PARAMETERS))
    rows[valid, :RIGID] = pull if which == 1 else -pull
    rows[valid, columns[which]] = np.einsum("ni,nij->nj", pull, twists[which][ours.plane[valid]])
    rows[valid, columns[1 - which]] = -np.einsum("ni,nij->nj", pull, twists[1 - which][near])
    return OneWay(ours.values, found, rows, points)


def _normalised(values: FloatArray) -> tuple[FloatArray, float]:
    away = values - values.mean()
    size = float(np.sqrt(away @ away))
    return away / max(size, 1e-12), max(size, 1e-12)
