"""What a frame's pairs with others say of its patches, by what a reconstruction keeps or computed anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import Sweep, read_frame
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame

NEIGHBOURS = 8
"""Frames before and after with which a frame can be compared where no reconstruction says which are alike."""

_KEPT_FRAMES = 4


@dataclass(frozen=True)
class PatchValues:
    """Patches of one frame as its pair with another has them.

    Attributes
    ----------
    centre_mm : ndarray, shape (p, 2)
        Where the patches lie in this frame.
    turn_rad : float
        By which they are turned there.
    correlation, distance_mm, sigma_mm : ndarray, shape (p,)
        NaN where there is none.
    used : ndarray of bool, shape (p,), or None
        Patches that the plane of the pair rests on; None where nothing was reconstructed.
    moved_mm : tuple of (float, float) or None
        How far the image's centre is from the other frame along its elevational axis, and standard deviation.
    """

    centre_mm: FloatArray
    turn_rad: float
    correlation: FloatArray
    distance_mm: FloatArray
    sigma_mm: FloatArray
    used: BoolArray | None
    moved_mm: tuple[float, float] | None


class SweepPairs:
    """Pairs of a sweep's frames.

    Parameters
    ----------
    sweep : Sweep
    config : Config
        With which patches are laid and correlated.
    pairs : FramePairs, optional
        Of the sweep's reconstruction. Correlations are not kept in it: they are computed anew.
    by_orientation : bool
        Whether the patches used are those that agree with a sensed orientation, or all of the plane.
    """

    def __init__(
        self, sweep: Sweep, config: Config, pairs: FramePairs | None = None, by_orientation: bool = False
    ) -> None:
        self._sweep, self._config, self._pairs = sweep, config, pairs
        self.by_orientation = by_orientation
        # The next frame is most often compared with this one.
        self._ready = lru_cache(maxsize=_KEPT_FRAMES)(self._make_ready)
        self._most: dict[int, tuple[float, float]] = {}

    @property
    def are_reconstructed(self) -> bool:
        """Whether there are distances."""
        return self._pairs is not None and len(self._pairs) > 0

    @cached_property
    def patch_mm(self) -> tuple[float, float]:
        """Width and height of a patch."""
        patches = self._matcher.patches
        width, height = (patches.size * patches.spacing_mm).tolist()
        return width, height

    def most_mm(self, lag: int) -> tuple[float, float]:
        """Distance and standard deviation that all but a hundredth of the patches stay below.

        Of the pairs that are `lag` frames apart, so that colours mean the same from frame to frame.
        """
        if lag not in self._most and self._pairs is not None:
            alike = (self._pairs.second - self._pairs.first) == lag
            some = alike if alike.any() else slice(None)
            self._most[lag] = (_high(self._pairs.distance_mm[some]), _high(self._pairs.sigma_mm[some]))
        return self._most.get(lag, (1.0, 1.0))

    def others(self, frame: int) -> list[int]:
        """Frames that this one is compared with, in order."""
        if self._pairs is None:
            near = range(max(0, frame - NEIGHBOURS), min(len(self._sweep), frame + NEIGHBOURS + 1))
            return [other for other in near if other != frame]
        before = self._pairs.first[self._pairs.second == frame]
        after = self._pairs.second[self._pairs.first == frame]
        # What frames that no pair joins have in common with the next shows why.
        beside = [other for other in (frame - 1, frame + 1) if 0 <= other < len(self._sweep)]
        return sorted({*before.tolist(), *after.tolist(), *beside})

    def values(self, frame: int, other: int, with_correlation: bool) -> PatchValues:
        """Patches of a frame by its pair with another.

        Parameters
        ----------
        with_correlation : bool
            Whether to correlate the two frames, which takes as long as some pictures.
        """
        first, second = sorted((frame, other))
        patches = self._matcher.patches
        nothing = np.full(len(patches), np.nan)
        correlation, row = nothing, self._row(first, second)
        first_from_second = RigidTransform.identity()
        if with_correlation or row is None:
            fixed, moving = self._ready(first), self._ready(second)
            match = self._matcher.match(fixed, moving, self._matcher.search(fixed, moving))
            correlation = match.correlation
            x, y, roll = match.motion.x_mm, match.motion.y_mm, match.motion.roll_rad
            centre = RigidTransform.from_translation(self._matcher.centre_mm)
            turned = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, roll]))
            # Of frames that have nothing in common any motion is found.
            if match.median >= self._config.trajectory.least_correlation:
                shifted = RigidTransform.from_translation([x, y, 0.0])
                first_from_second = shifted * centre * turned * centre.inv()
        if row is not None and self._pairs is not None:
            first_from_second = RigidTransform.from_matrix(self._pairs.first_from_second[row])
        centre_mm, turn = self._placed(first_from_second, moved=frame == second)
        if row is None or self._pairs is None:
            return PatchValues(centre_mm, turn, correlation, nothing, nothing, None, None)
        apart = abs(float(first_from_second.apply(self._matcher.centre_mm)[2]))
        return PatchValues(
            centre_mm,
            turn,
            correlation,
            self._pairs.distance_mm[row].astype(float),
            self._pairs.sigma_mm[row].astype(float),
            self._pairs.used[row],
            (apart, float(np.sqrt(self._pairs.covariance[row, 2, 2]))),
        )

    def _make_ready(self, frame: int) -> ReadyFrame:
        return self._matcher.prepare(self._matcher.echo(read_frame(self._sweep.frames, frame)))

    def _row(self, first: int, second: int) -> int | None:
        if self._pairs is None:
            return None
        rows = np.flatnonzero((self._pairs.first == first) & (self._pairs.second == second))
        return int(rows[0]) if rows.size else None

    def _placed(self, first_from_second: RigidTransform, moved: bool) -> tuple[FloatArray, float]:
        """Centres of the patches, which tile the earlier frame, in it or in the later one."""
        at = self._matcher.patches.centre_mm
        if not moved:
            return at, 0.0
        there = first_from_second.inv()
        inside = there.apply(np.column_stack([at, np.zeros(len(at))]))[:, :2]
        matrix = there.rotation.as_matrix()
        return inside, float(np.arctan2(matrix[1, 0], matrix[0, 0]))

    @cached_property
    def _matcher(self) -> FrameMatcher:
        c = self._config
        matcher = FrameMatcher(self._sweep, c.intensity, c.patches, c.inplane, c.matching)
        if self._pairs is not None:
            matcher.keep_depths(np.unique(self._pairs.patch_centre_mm[:, 1]))
        return matcher


def _high(values: npt.NDArray[np.floating]) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, 99)) if known.size else 1.0


def nearest_lag(frame: int, others: Sequence[int], lag: int) -> int | None:
    """Of some frames, the one whose distance in frames from `frame` is nearest to `lag`; None without any."""
    return min(others, key=lambda other: (abs(other - frame - lag), abs(other - frame), other), default=None)
