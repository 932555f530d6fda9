"""Values of a frame's patches by its pairs with others: from a reconstruction, or computed anew."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import Sweep
from speckle3d.kernels.inplane import Frame
from speckle3d.matching.matcher import FrameMatcher

NEIGHBOURS = 8
"""Frames before and after with which a frame can be compared."""


@dataclass(frozen=True)
class PatchValues:
    """Patches of one frame as its pair with another has them.

    Attributes
    ----------
    centre_mm : ndarray, shape (p, 2)
        Where the patches lie in this frame.
    turn_rad : ndarray, shape (p,)
        By which they are turned there, a fan's vectors included.
    correlation, distance_mm, sigma_mm : ndarray, shape (p,)
        NaN where there is none.
    inliers : ndarray of bool, shape (p,), or None
        Patches that the plane of the pair rests on; None for a pair that was not reconstructed.
    elevation_mm : tuple of (float, float) or None
        How far the image's centre is from the other frame along its elevational axis, and standard deviation.
    """

    centre_mm: FloatArray
    turn_rad: FloatArray
    correlation: FloatArray
    distance_mm: FloatArray
    sigma_mm: FloatArray
    inliers: BoolArray | None = None
    elevation_mm: tuple[float, float] | None = None


class SweepPairs:
    """Pairs of a sweep's frames.

    Parameters
    ----------
    sweep : Sweep
    config : Config
        With which patches are laid and correlated.
    pairs : FramePairs, optional
        Of the sweep's reconstruction. Correlations are not kept in it: they are computed anew.
    """

    def __init__(self, sweep: Sweep, config: Config, pairs: FramePairs | None = None) -> None:
        self._sweep, self._config, self._pairs = sweep, config, pairs
        self._ready = lru_cache(4)(self._make_ready)  # the next frame is most often compared with this one

    @property
    def have_distances(self) -> bool:
        """Whether there are distances."""
        return self._pairs is not None and len(self._pairs) > 0

    @cached_property
    def patch_mm(self) -> tuple[float, float]:
        """Width and height of a patch."""
        width, height = (self._matcher.patches.size * self._matcher.patches.spacing_mm).tolist()
        return width, height

    def most(self, by: str) -> float:
        """End of a colour scale: what all but a hundredth of the patches of all pairs stay below."""
        if by not in ("distance", "sigma") or self._pairs is None:
            return 1.0
        return float(np.nanpercentile(getattr(self._pairs, f"{by}_mm"), 99))

    def values(self, frame: int, partner: int, with_correlation: bool) -> PatchValues:
        """Patches of a frame by its pair with another.

        Parameters
        ----------
        with_correlation : bool
            Whether to correlate the two frames, which takes as long as some pictures.
        """
        first, second = sorted((frame, partner))
        row, nothing = self._row(first, second), np.full(len(self._matcher.patches), np.nan)
        correlation, first_from_second = nothing, RigidTransform.identity()
        if with_correlation or row is None:
            correlation, first_from_second = self._match(first, second)
        columns: dict[str, Any] = {"distance_mm": nothing, "sigma_mm": nothing}
        if row is not None and (pairs := self._pairs) is not None:
            first_from_second = RigidTransform.from_matrix(pairs.first_from_second[row])
            elevation = abs(float(first_from_second.apply(self._matcher.centre_mm)[2]))
            columns = {name: getattr(pairs, name)[row].astype(float) for name in columns}
            columns["inliers"] = pairs.used[row]
            columns["elevation_mm"] = elevation, float(pairs.covariance[row, 2, 2] ** 0.5)
        return PatchValues(*self._places(first_from_second, frame == second), correlation, **columns)

    def _match(self, first: int, second: int) -> tuple[FloatArray, RigidTransform]:
        """Correlation of every patch, and the motion in the plane if the frames have anything in common."""
        fixed, moving = self._ready(first), self._ready(second)
        start = self._matcher.search(fixed, moving)
        table = self._matcher.match({first: fixed}, second, moving, [start])
        correlation = table.correlation[0].astype(float)
        if table.median[0] < self._config.trajectory.least_correlation:
            return correlation, RigidTransform.identity()
        x_mm, y_mm, roll_rad = table.inplane[0]
        centre = RigidTransform.from_translation(self._matcher.centre_mm)
        motion = RigidTransform.from_components([x_mm, y_mm, 0.0], Rotation.from_rotvec([0.0, 0.0, roll_rad]))
        return correlation, centre * motion * centre.inv()

    def _make_ready(self, frame: int) -> Frame:
        return self._matcher.ready(self._sweep.frames[frame]).frame

    def _row(self, first: int, second: int) -> int | None:
        if self._pairs is None:
            return None
        rows = np.flatnonzero((self._pairs.first == first) & (self._pairs.second == second))
        return int(rows[0]) if rows.size else None

    def _places(self, first_from_second: RigidTransform, in_second: bool) -> tuple[FloatArray, FloatArray]:
        """Centres of the patches, which tile the earlier frame, in it or in the later one, and their turn."""
        at, angle = self._matcher.patches.centre_mm, self._matcher.patches.angle_rad
        if not in_second:
            return at, -angle
        second_from_first = first_from_second.inv()
        centre_mm = second_from_first.apply(np.column_stack([at, np.zeros(len(at))]))[:, :2]
        return centre_mm, float(second_from_first.rotation.as_euler("zyx")[0]) - angle

    @cached_property
    def _matcher(self) -> FrameMatcher:
        matcher = FrameMatcher(self._sweep, self._config)
        if self._pairs is not None:
            grid, (_, sample) = matcher.grid, matcher.grid.sample_at(self._pairs.patch_centre_mm).T
            depth_mm = np.unique(grid.first_sample_depth_mm + sample * grid.sample_spacing_mm)
            matcher.patches = matcher.laid.between(depth_mm)
        return matcher
