"""Search for the relative position of two sweeps by masked correlation of coarse volumes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import affine_transform, maximum_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.correction.crossing.planes import BENDS, StraightSweep, relative_turn
from speckle3d.correction.crossing.similarity import Placing
from speckle3d.correction.crossing.texture import gaussian_mean

VOXEL_MM = 1.6
"""Blur and voxel of the search: refinement starts from 6 mm away, so that twice as much moves no length."""
_TURNS_DEG = np.array([30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0])
"""Turns about the beam tried, either way: refinement starts from 12 degrees away. Beyond a right angle the
probe is held the other way round."""


class Candidate(NamedTuple):
    """A start, and how much the coarse volumes speak for it.

    Attributes
    ----------
    mirrored : tuple of bool
        Which of the sweeps went the other way than its poses say.
    score : float
        Fisher's transform of the correlation times the root of the voxels compared.
    """

    placing: Placing
    mirrored: tuple[bool, bool]
    score: float

    def is_near(self, start: Candidate) -> bool:
        """Whether refinement of both would end in one place."""
        alike = self.mirrored == start.mirrored
        return alike and self.placing.is_near(start.placing, 1.2 * VOXEL_MM, np.deg2rad(20.0))


def candidates(
    sides: Callable[[int, bool], StraightSweep], depth_shift_mm: float, keep: int
) -> list[Candidate]:
    """Find the best starts, best first, at the turn that sensors tell or at many about the beam.

    Parameters
    ----------
    sides : callable
        First (0) or second (1) sweep, as its poses say or mirrored.
    depth_shift_mm : float
        Furthest displacement along the beam.
    keep : int
        How many to return.
    """
    turns = Rotation.from_rotvec(np.deg2rad(np.outer([*_TURNS_DEG, *-_TURNS_DEG], [0.0, 1.0, 0.0])))
    starts: list[Candidate] = []
    by_sensors = relative_turn(sides(0, False), sides(1, False)) is not None
    # Without sensors, two sweeps that are both mirrored look the same at the opposite turn.
    for mirrored in product((False, True)[: 1 + by_sensors], (False, True)):
        pair = [sides(number, flip) for number, flip in enumerate(mirrored)]
        textures = [gaussian_mean(side.texture, VOXEL_MM, side.spacing_mm) for side in pair]
        sensed_turn = relative_turn(*pair)
        first = _resample(pair[0], textures[0], Rotation.identity())
        for turn in turns if sensed_turn is None else [sensed_turn]:
            second = _resample(pair[1], textures[1], turn)
            for shift, score in _peaks(first, second, depth_shift_mm):
                place = Placing(RigidTransform.from_components(shift, turn), np.zeros((2, BENDS)))
                starts.append(Candidate(place, mirrored, score))
    distinct: list[Candidate] = []
    for start in sorted(starts, key=lambda c: -c.score):
        if len(distinct) < keep and not any(start.is_near(better) for better in distinct):
            distinct.append(start)
    return distinct


class _TextureGrid(NamedTuple):
    """Texture on a regular grid along the first path's axes; zero where there is none."""

    low_mm: FloatArray
    values: Float32Array
    mask: Float32Array


def _resample(sweep: StraightSweep, texture: Float32Array, turn: Rotation) -> _TextureGrid:
    """Take the planes for parallel: refinement starts from further away than paths bend."""
    size, shape = sweep.spacing_mm, np.array(texture.shape)
    first = np.array([-(shape[0] // 2) * size[0], *sweep.pixels[2:]])
    # From (along, across, deep) to the path's axes (across, deep, along), turned.
    axes = turn.as_matrix()[:, [2, 0, 1]]
    corners = axes @ (first[:, None] + (size * (shape - 1))[:, None] * np.indices((2, 2, 2)).reshape(3, 8))
    low = np.floor(corners.min(axis=1) / VOXEL_MM) * VOXEL_MM
    whole = (np.ceil((corners.max(axis=1) - low) / VOXEL_MM) + 1).astype(int)
    matrix, offset = VOXEL_MM * axes.T / size[:, None], (axes.T @ low - first) / size
    values = affine_transform(texture, matrix, offset, tuple(whole), order=1, cval=np.nan)
    valid = np.isfinite(values)
    return _TextureGrid(low, np.where(valid, values, np.float32(0.0)), valid.astype(np.float32))


def _peaks(
    fixed: _TextureGrid, moving: _TextureGrid, depth_shift_mm: float
) -> list[tuple[FloatArray, float]]:
    """Shifts of the moving volume at which the two correlate best, with score."""
    # Textures have no mean, so that sums of products are covariances.
    a = np.stack([fixed.mask, fixed.values**2, fixed.mask, fixed.values])
    b = np.stack([moving.mask, moving.mask, moving.values**2, moving.values])[:, ::-1, ::-1, ::-1]
    whole = np.add(a.shape[1:], b.shape[1:]) - 1
    size, axes = [next_fast_len(int(n), real=True) for n in whole], (1, 2, 3)
    sums = irfftn(rfftn(a, size, axes) * rfftn(b, size, axes), size, axes)
    count, power_a, power_b, cross = sums[:, : whole[0], : whole[1], : whole[2]]
    power = power_a * power_b
    correlation = cross / np.sqrt(np.maximum(power, 1e-3 * float(power.max())))
    score = np.arctanh(np.clip(correlation, -0.99, 0.99)) * np.sqrt(np.maximum(count, 0.0))
    # Without shift both volumes begin at index `shape - 1` of the moving one.
    origin_mm = fixed.low_mm - moving.low_mm - VOXEL_MM * (np.array(moving.mask.shape) - 1)
    depth_mm = origin_mm[1] + VOXEL_MM * np.arange(score.shape[1])
    score[:, np.abs(depth_mm) > depth_shift_mm] = -np.inf
    top = np.isfinite(score) & (score == maximum_filter(score, 3))
    best = np.argwhere(top)[np.argsort(-score[top])[:2]]
    return [(origin_mm + VOXEL_MM * at, float(score[tuple(at)])) for at in best]
