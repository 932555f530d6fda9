"""Stages that a sweep on the disk and one that is being made go through alike."""

from __future__ import annotations

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import TISSUE_SIGMA, DecorrelationCurves
from speckle3d.core.doubts import unrefuted
from speckle3d.core.errors import MismatchError, naming
from speckle3d.core.sweep import Sweep
from speckle3d.matching.blocks import StageTimes
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.quality import FrameFlag
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.curve_doubts import DepthFactors, doubt_widths
from speckle3d.motion.curve_prior import RowsSeen, rows_seen, straightened
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.signs import SignedPairs

PLANES = "distances and planes"
"""Name of the stage in `StageTimes`."""


def matcher_for(sweep: Sweep, curves: DecorrelationCurves, config: Config) -> FrameMatcher:
    """Make the matcher of a sweep's frames, none of which is read.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth.
    """
    matcher = FrameMatcher(sweep, config.intensity, config.patches, config.inplane, config.matching)
    curves.key.require_same(matcher.key)
    unrefuted(doubt_widths(curves), sweep.name, MismatchError)
    with naming(sweep.name):
        matcher.keep_depths(curves.depth_mm)
    return matcher


def measured(
    table: CorrelationTable,
    flags: IntArray,
    reader: PairReader,
    config: Config,
    times: StageTimes,
    known: FloatArray | None = None,
) -> tuple[SignedPairs, Coherence | None, FloatArray]:
    """Signed planes of all usable pairs, the coherence they were read with, and the path they give.

    Coherence is estimated from distances, and distances are read with coherence: each twice, in turn.
    """
    sound = sound_pairs(table, flags)
    path = known
    if path is None:
        with times.of(PLANES):
            path = reader.rough_path(table)
    if not config.coherence.adapt:
        with times.of(PLANES):
            pairs = reader.measure(table, path, sound, None)
        return pairs, None, reader.path(table, pairs, None)
    for known_scale in (False, True):
        with times.of("coherence"):
            coherence, path = reader.coherence(table, path, sound, config.coherence, known_scale)
        with times.of(PLANES):
            pairs = reader.measure(table, path, sound, coherence)
            path = reader.path(table, pairs, coherence)
    return pairs, coherence, path


def sound_pairs(table: CorrelationTable, flags: IntArray) -> BoolArray:
    """Pairs of frames that are to be trusted, shape (e,)."""
    bad = (flags & ~FrameFlag.UNMATCHED) != 0
    sound: BoolArray = ~bad[table.first] & ~bad[table.second]
    return sound


def straightened_by(
    factors: DepthFactors,
    curves: DecorrelationCurves,
    coherence: Coherence | None,
    patches: PatchGrid,
    config: Config,
) -> tuple[DecorrelationCurves, float]:
    """Curves of the lens that the depths of the images agree on, and what is left of their mismatch.

    The curves given, and all of it, if they are to stay as they are.
    """
    mismatch = curves.mismatch(config.curves.same_probe)
    if config.curves.straighten and mismatch > TISSUE_SIGMA and curves.origin in ("phantom", "data sheet"):
        return straightened(curves, rows_of(factors, coherence, patches), mismatch)
    return curves, mismatch


def rows_of(factors: DepthFactors, coherence: Coherence | None, patches: PatchGrid) -> RowsSeen:
    """What rows of patches say of the curves."""
    if coherence is None:
        return rows_seen(factors)
    return rows_seen(factors, patches.rows_of(coherence.share.mean(axis=0)).mean(axis=-1))
