"""Do the curves belong to the sweep? What its own correlations, patches and clock say.

A factor that all of a curve's distances have in common cannot be told from images: the same frames are then
seen as far apart, and everything below fits as well as before. What can be told is curves that are wrong by
another factor at each depth, since all depths of one image move together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves, SpeckleSize
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import Sweep
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.texture import Texture
from speckle3d.motion.coherence import NOISY_GAIN, RowScales
from speckle3d.motion.estimate import Motion

FASTEST_MM_S = 300.0
"""Mean speed above which no hand sweeps a probe: scans take 1 to 50 mm/s, a fast one some 100."""
BENT, REFUTED_BEND = 0.12, 0.25
"""Standard deviation over depth of the logarithm of distances. Simulated: right curves up to 0.06 in phantom,
tissue and noise; of a lens whose focus is 10 % off 0.11; shipped ones 10 mm too high 0.20, reversed 0.53."""
RESIZED = {"lateral_mm": 0.13, "axial_mm": 0.3}
REFUTED_SIZE = {"lateral_mm": 0.3, "axial_mm": 0.6}
"""Median over depth of the logarithm of speckle sizes over the phantom's, either sign. Simulated: lateral up
to 0.03 in phantom, 0.10 in tissue, 0.19 to 0.31 at depths wrong by 10 mm; axial 0.08, with attenuation wrong
by 0.3 dB/cm/MHz 0.17, with a sampling rate wrong by a factor of two 0.69."""
LEAST_ROWS, ENOUGH_ROWS = 3, 4
"""Rows of patches from which doubts arise, and from which sizes refute."""
UNSEEN_NOISE, REFUTED_NOISE = 1.8, 2.5
"""Correlation of neighbouring vectors over what the noise taken from distances would leave of it. Simulated:
up to 1.1 in nearly all of 64 good sweeps, 1.5 in the worst."""
UNEVEN = 0.32
"""Median logarithm of two steps' sum over the one step that spans both, either sign. Simulated: below 0.02 in
half of 64 good sweeps, 0.24 in the worst; with a fifth of the curves' correlation missing 0.38. Noise moves
it in images of few patches: alone, it refutes nothing."""
LEAST_TRIPLES = 12
FLAT = 0.3
"""Part of the distance that halves the correlation, below which it is too flat for distances to be summed."""
_ROW_ERROR = 0.03
"""Of a row's factor, from the curves and tissue."""


def examine_curves(sweep: Sweep, texture: Texture, motion: Motion, usable: BoolArray) -> tuple[Doubt, ...]:
    """Hold the curves against a sweep's own speckle and steps.

    Raises
    ------
    MismatchError
        If they are refuted.
    """
    problem, pairs = motion.problem, motion.pairs
    size = texture.speckle_size(usable)
    least = FLAT * float(problem.typical_distance(np.sqrt(0.5)))
    ratios = sum_ratios(pairs.first, pairs.second, pairs.offset_mm, least)
    doubts = doubt_curves(size, rows_without_tilt(motion), ratios, problem.curves, problem.patches)
    return unrefuted([*doubt_speed(motion.path, sweep.frame_time_s), *doubts], sweep.name, MismatchError)


def rows_without_tilt(motion: Motion) -> RowScales | None:
    """Scales of rows over the centre's distance alone: what tilt explains may be wrong curves."""
    rows, problem = motion.rows, motion.problem
    if rows is None:
        return None
    steps = np.diff(motion.path, axis=0)
    tilt_per_mm = float(steps[:, 2] @ steps[:, 0]) / max(float(steps[:, 0] @ steps[:, 0]), 1e-12)
    lever = np.median(problem.patches.rows_of(problem.levers.lever_mm), axis=-1)
    explained = np.log(np.maximum(np.abs(1.0 + tilt_per_mm * lever), 1e-3))
    return replace(rows, logarithm=rows.logarithm + explained - np.median(explained))


def doubt_curves(
    seen: SpeckleSize,
    rows: RowScales | None,
    ratios: FloatArray,
    curves: DecorrelationCurves,
    patches: PatchGrid,
) -> tuple[Doubt, ...]:
    """Doubts that a sweep's own speckle raises: by its size, noise, depths that disagree, and steps' sums.

    Size, depths and sums say so independently of each other: two of them at once refute the curves.
    """
    gain = np.ones(patches.row_depth_mm.size) if rows is None else np.nan_to_num(rows.gain, nan=1.0)
    kinds = doubt_size(seen, curves, patches, gain), doubt_bend(rows), doubt_sums(ratios)
    found = tuple(doubt for kind in kinds for doubt in kind)
    if sum(map(bool, kinds)) > 1:
        found = tuple(replace(doubt, refuted=True) for doubt in found)
    return (*found, *doubt_noise(seen, curves, patches, gain))


def doubt_speed(path: FloatArray, time_s: FloatArray) -> tuple[Doubt, ...]:
    """Doubt distances that no hand travels in the time.

    Parameters
    ----------
    path : ndarray, shape (n, 2)
        Elevational position of each frame's centre, mm, and its slope along x.
    time_s : ndarray, shape (n,)
    """
    speed = float(np.abs(np.diff(path[:, 0])).sum() / (time_s[-1] - time_s[0]))
    if speed <= FASTEST_MM_S:
        return ()
    return (
        Doubt(
            "curves",
            "units",
            f"expected a hand's speed of at most {FASTEST_MM_S:g} mm/s, got {speed:.0f} mm/s by the curves "
            "and the frame times",
            refuted=True,
        ),
    )


def bend(rows: RowScales) -> float:
    """Weighted standard deviation of the logarithm's smooth course over depth: a parabola through clear rows.

    A lens or a depth that is wrong bends all rows smoothly; rows that stand out alone hold structure.
    """
    clear = rows.gain >= NOISY_GAIN
    if clear.sum() < ENOUGH_ROWS:
        return 0.0
    depth, logarithm = rows.depth_mm[clear], rows.logarithm[clear]
    design = np.vander((depth - depth.mean()) / np.ptp(depth), 3)

    def misfit(values: FloatArray) -> FloatArray:
        return np.asarray(design @ values - logarithm)

    fit = least_squares(misfit, np.zeros(3), loss="soft_l1", f_scale=_ROW_ERROR)
    return float(np.std(design @ fit.x))


def doubt_bend(rows: RowScales | None) -> tuple[Doubt, ...]:
    """Doubt curves by which depths of one image are not as far from the next."""
    size = 0.0 if rows is None else bend(rows)
    if rows is None or size < BENT:
        return ()
    ratio = np.exp(np.nanmax(rows.logarithm) - np.nanmin(rows.logarithm))
    return (
        Doubt(
            "curves",
            "curves of another probe, lens or depth",
            f"expected all depths to tell the same distance, got distances at {rows.depth_mm[0]:.0f} to "
            f"{rows.depth_mm[-1]:.0f} mm that differ by a factor of {ratio:.2f} "
            f"({100 * size:.0f} % rms, at most {100 * BENT:.0f} expected)",
            refuted=size > REFUTED_BEND,
        ),
    )


def sum_ratios(first: IntArray, second: IntArray, distance_mm: FloatArray, least_mm: float) -> FloatArray:
    """Sums of two distances over the one that spans both, of all three frames that go one way.

    Parameters
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair.
    distance_mm : ndarray, shape (e,)
        Signed, at the image's centre.
    least_mm : float
        Distances below are passed over.
    """
    to: dict[int, dict[int, float]] = {}
    for i, j, d in zip(first.tolist(), second.tolist(), distance_mm.tolist(), strict=True):
        if abs(d) > least_mm:
            to.setdefault(j, {})[i] = d
    ratios = [
        (before + after) / whole
        for spans in to.values()
        for j, after in spans.items()
        for i, before in to.get(j, {}).items()
        if (whole := spans.get(i, 0.0)) * after > 0 and before * after > 0
    ]
    return np.array(ratios)


def doubt_sums(ratios: FloatArray) -> tuple[Doubt, ...]:
    """Doubt curves by which two steps are not as long as the one that spans both."""
    if ratios.size < LEAST_TRIPLES:
        return ()
    middle = float(np.median(ratios))
    if abs(np.log(middle)) <= UNEVEN:
        return ()
    return (
        Doubt(
            "curves",
            "curves of another signal or with noise",
            f"expected two steps to be as long as the one that spans both, got {middle:.2f} times its length "
            f"(median of {ratios.size})",
            refuted=False,
        ),
    )


def doubt_size(
    seen: SpeckleSize, curves: DecorrelationCurves, patches: PatchGrid, left: FloatArray
) -> tuple[Doubt, ...]:
    """Doubt a sweep whose speckle is not as large as the curves' phantom's at the same depths.

    Parameters
    ----------
    seen : SpeckleSize
        Of the rows of patches; NaN where they hold no speckle.
    left : ndarray, shape (r,)
        Part of the correlation of each row of patches that noise leaves.
    """
    if curves.speckle is None:
        return ()
    known = curves.speckle.at(patches.row_depth_mm, curves.depth_mm)
    excused = (left < NOISY_GAIN) & (_unseen_noise(seen, known, left, patches) < UNSEEN_NOISE)
    found = []
    for name in ("lateral_mm", "axial_mm"):
        here, there = getattr(seen, name), getattr(known, name)
        fair = np.isfinite(here)
        if fair.sum() < LEAST_ROWS:
            continue
        ratio = np.log(here[fair] / there[fair])
        # Noise differs from sample to sample, so that speckle under it looks finer.
        off = float(np.median(np.where(excused[fair], np.maximum(ratio, 0.0), np.abs(ratio))))
        if off > RESIZED[name]:
            found.append(
                Doubt(
                    "curves",
                    "another probe, depth or sampling rate",
                    f"expected {name.removesuffix('_mm')} speckle of {np.median(there[fair]):.3f} mm, as in "
                    f"the curves' phantom, got {np.median(here[fair]):.3f} mm ({100 * off:.0f} % off at the "
                    "median depth)",
                    refuted=bool(off > REFUTED_SIZE[name] and fair.sum() >= ENOUGH_ROWS),
                )
            )
    return tuple(found)


def doubt_noise(
    seen: SpeckleSize, curves: DecorrelationCurves, patches: PatchGrid, left: FloatArray
) -> tuple[Doubt, ...]:
    """Doubt distances read with noise that the images do not show.

    Noise takes as much from the correlation of neighbouring vectors as from that of frames. Where frames lack
    correlation that vectors have, it was not noise that took it, and the curves are read at wrong distances.

    Parameters
    ----------
    seen, gain
        As for `doubt_size`.
    """
    if curves.speckle is None:
        return ()
    known = curves.speckle.at(patches.row_depth_mm, curves.depth_mm)
    excess = _unseen_noise(seen, known, left, patches)
    if excess < UNSEEN_NOISE:
        return ()
    return (
        Doubt(
            "curves",
            "curves of another probe, lens or depth",
            f"expected the noise that distances were read with, {100 * (1 - np.median(left)):.0f} % of the "
            f"correlation, between vectors too, got {excess:.1f} times the correlation that it leaves there",
            refuted=excess > REFUTED_NOISE,
        ),
    )


def _unseen_noise(seen: SpeckleSize, known: SpeckleSize, left: FloatArray, patches: PatchGrid) -> float:
    """Median over depth of neighbouring vectors' correlation over what noise would leave of the phantom's."""
    fair = np.isfinite(seen.lateral_mm)
    if fair.sum() < LEAST_ROWS:
        return 1.0
    here, there = (np.exp(-0.5 * (patches.spacing_mm[0] / s.lateral_mm[fair]) ** 2) for s in (seen, known))
    return float(np.median(here / (there * left[fair])))
