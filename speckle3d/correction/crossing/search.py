"""Where the sweeps may lie against each other: masked correlation of coarse volumes at many turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.correction.crossing.path import BENDS, StraightSweep
from speckle3d.correction.crossing.similarity import Placing
from speckle3d.correction.crossing.texture import at_blur
from speckle3d.kernels.crossing import look_up

BLUR_MM, VOXEL_MM = 1.6, 1.6
"""Blur and voxel of the search: refinement starts from 6 mm away."""
TURNS_DEG = (30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0)
"""Turns about the beam tried, either way: refinement starts from 12 degrees away. Beyond a right angle the
probe is held the other way round."""
SCALES = (-0.14, 0.0, 0.14)
"""Logarithms of both sweeps' scale tried."""
_LEAST_SHARE = 0.25
"""Share of the smaller volume that must overlap."""
_APART_MM = 5.0
"""Candidates of one turn nearer than this are one."""


@dataclass(frozen=True)
class Candidate:
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
    correlation: float


@dataclass(frozen=True)
class Hypothesis:
    """A turn of the second path against the first, and which sweeps are mirrored."""

    turn: Rotation
    mirrored: tuple[bool, bool]


def turns_about_beam() -> list[Hypothesis]:
    """Every turn tried if no sensor tells. Mirrored both, the sweeps look the same at the opposite turn."""
    turns = np.deg2rad(np.concatenate([TURNS_DEG, -np.array(TURNS_DEG)]))
    return [
        Hypothesis(Rotation.from_rotvec([0.0, turn, 0.0]), (False, flip))
        for turn in turns
        for flip in (False, True)
    ]


def candidates(
    sweeps: Sequence[Sequence[StraightSweep]],
    textures: Sequence[Sequence[Float32Array]],
    hypotheses: Sequence[Hypothesis],
    depth_shift_mm: float,
    keep: int,
) -> list[Candidate]:
    """Find the best starts.

    Parameters
    ----------
    sweeps, textures : sequence of sequence
        By sweep, then as given and mirrored.
    hypotheses : sequence of Hypothesis
    depth_shift_mm : float
        Furthest displacement along the beam.
    keep : int
        How many to return.

    Returns
    -------
    list of Candidate
        Best first.
    """
    found: list[Candidate] = []
    coarse = [
        [at_blur(t, BLUR_MM, s.spacing_mm) for s, t in zip(*both, strict=True)]
        for both in zip(sweeps, textures, strict=True)
    ]
    for scale in SCALES:
        bends = np.zeros((2, len(BENDS)))
        bends[:, 0] = scale
        fixed: dict[bool, _Volume] = {}
        for each in hypotheses:
            one, other = each.mirrored
            if one not in fixed:
                fixed[one] = _Volume.of(sweeps[0][one], coarse[0][one], Rotation.identity(), bends[0])
            second = _Volume.of(sweeps[1][other], coarse[1][other], each.turn, bends[1])
            for shift, score, correlation in _peaks(fixed[one], second, depth_shift_mm):
                place = RigidTransform.from_components(shift, each.turn)
                found.append(Candidate(Placing(place, bends.copy()), each.mirrored, score, correlation))
    chosen: list[Candidate] = []
    for candidate in sorted(found, key=lambda c: -c.score):
        if len(chosen) < keep and not any(_alike(candidate, other) for other in chosen):
            chosen.append(candidate)
    return chosen


def same_place(one: Placing, other: Placing, apart_mm: float, apart_rad: float) -> bool:
    """Whether two placings differ by less than a shift and a turn."""
    away = one.first_from_second.inv() * other.first_from_second
    near = np.linalg.norm(one.first_from_second.translation - other.first_from_second.translation) < apart_mm
    return bool(near and away.rotation.magnitude() < apart_rad)


def _alike(one: Candidate, other: Candidate) -> bool:
    """Whether refinement of two candidates would end in one place."""
    same = one.mirrored == other.mirrored
    return same and same_place(one.placing, other.placing, 1.2 * _APART_MM, np.deg2rad(20.0))


@dataclass(frozen=True)
class _Volume:
    """Texture on a regular grid along the first path's axes."""

    low_mm: FloatArray
    values: Float32Array
    there: BoolArray

    @classmethod
    def of(cls, sweep: StraightSweep, texture: Float32Array, turn: Rotation, bends: FloatArray) -> _Volume:
        bent = sweep.path.bent(bends)
        wide, high = sweep.volume.shape[1:]
        x = sweep.pixels[2] + np.array([0, wide - 1]) * sweep.pixels[0]
        y = sweep.pixels[3] + np.array([0, high - 1]) * sweep.pixels[1]
        corners = np.array([[i, j, 0.0, 1.0] for i in x for j in y])
        box = turn.apply((bent @ corners.T)[:, :3].transpose(0, 2, 1).reshape(-1, 3))
        low = np.floor(box.min(axis=0) / VOXEL_MM) * VOXEL_MM
        shape = (np.ceil((box.max(axis=0) - low) / VOXEL_MM) + 1).astype(int)
        grid = low + np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * VOXEL_MM
        points = turn.inv().apply(grid.reshape(-1, 3))
        values, place = np.empty(len(points)), np.empty(len(points))
        planes = np.ascontiguousarray(np.linalg.inv(bent)[:, :3])
        look_up(points, texture, planes, sweep.pixels, values, np.empty((0, 3)), place)
        there = np.isfinite(values).reshape(shape)
        return cls(low, np.where(there, values.reshape(shape), 0.0).astype(np.float32), there)


def _peaks(one: _Volume, other: _Volume, depth_shift_mm: float) -> list[tuple[FloatArray, float, float]]:
    """Shifts of the other volume at which the two correlate best, with score and correlation."""
    full = np.array(one.values.shape) + np.array(other.values.shape) - 1
    size = [next_fast_len(int(n), real=True) for n in full]
    a = [rfftn(v, size) for v in (one.values, one.values**2, one.there.astype(np.float32))]
    b = [np.conj(rfftn(v, size)) for v in (other.values, other.values**2, other.there.astype(np.float32))]
    together = [a[2] * b[2], a[0] * b[2], a[2] * b[0], a[1] * b[2], a[2] * b[1], a[0] * b[0]]
    count, sum_a, sum_b, sum_aa, sum_bb, sum_ab = (irfftn(each, size) for each in together)
    count = np.maximum(np.round(count), 1.0)
    cross = sum_ab - sum_a * sum_b / count
    spread = (sum_aa - sum_a**2 / count) * (sum_bb - sum_b**2 / count)
    correlation = cross / np.sqrt(np.maximum(spread, 1e-3 * float(spread.max())))
    # Lag n is at index n, negative ones from the end; lag moves the other volume up.
    lags = [
        np.where(np.arange(n) < s, np.arange(n), np.arange(n) - n)
        for n, s in zip(size, one.values.shape, strict=True)
    ]
    shift = np.stack(np.meshgrid(*lags, indexing="ij"), axis=-1) * VOXEL_MM + one.low_mm - other.low_mm
    least = _LEAST_SHARE * min(int(one.there.sum()), int(other.there.sum()))
    allowed = (count >= least) & (np.abs(shift[..., 1]) <= depth_shift_mm)
    score = np.where(allowed, np.arctanh(np.clip(correlation, -0.99, 0.99)) * np.sqrt(count), -np.inf)
    reach = 1 + 2 * int(_APART_MM / VOXEL_MM)
    top = np.isfinite(score) & (score == maximum_filter(score, reach, mode="wrap"))
    where = np.argwhere(top)
    best = where[np.argsort(-score[top])[:2]]
    return [(shift[tuple(i)], float(score[tuple(i)]), float(correlation[tuple(i)])) for i in best]
