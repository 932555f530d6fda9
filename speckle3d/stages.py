"""Stages that a sweep on the disk and one that is being made go through alike."""

from __future__ import annotations

from dataclasses import replace

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import unrefuted
from speckle3d.core.errors import MismatchError, naming
from speckle3d.core.sweep import Sweep
from speckle3d.matching.blocks import StageTimes
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFlag
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import SCALE_ROUNDS, Coherence, RowScales
from speckle3d.motion.curve_doubts import doubt_widths
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
) -> tuple[SignedPairs, Coherence | None, FloatArray, RowScales | None]:
    """Signed planes of all usable pairs, the coherence they were read with, and the path they give.

    Coherence and scale are estimated from the path's distances, and distances are read with coherence, in
    turn. Planes give the path its shape; its scale is at last the one that all patches ask for.
    """
    sound = sound_pairs(table, flags)
    path = known
    if path is None:
        with times.of(PLANES):
            path = reader.rough_path(table)
    if not config.coherence.adapt:
        with times.of(PLANES):
            pairs = reader.measure(table, path, sound, None)
        return pairs, None, reader.path(table, pairs, None), None
    with times.of("coherence"):
        coherence, scale, rows = reader.coherence(table, path, sound)
    for _ in range(SCALE_ROUNDS):
        with times.of(PLANES):
            pairs = reader.measure(table, path * scale, sound, coherence)
            path = reader.path(table, pairs, coherence)
        with times.of("coherence"):
            coherence, scale, rows = reader.coherence(table, path, sound)
    pairs = replace(pairs, planes=pairs.planes.scaled(scale))
    return pairs, coherence, reader.path(table, pairs, coherence), rows


def sound_pairs(table: CorrelationTable, flags: IntArray) -> BoolArray:
    """Pairs of frames that are to be trusted, shape (e,)."""
    bad = (flags & ~FrameFlag.UNMATCHED) != 0
    sound: BoolArray = ~bad[table.first] & ~bad[table.second]
    return sound
