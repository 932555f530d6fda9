"""Checks between the pipeline's stages: what a sweep's images, curves and sensors say against each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.sweep import Sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.standing import standing_share
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import SpeckleSizes, speckle_size
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.curve_doubts import DepthFactors, doubt_curves, doubt_speed
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.plausibility import far_apart, folded, severed, standing, undetermined
from speckle3d.motion.signs import SignedPairs


def doubts_of_curves(
    sweep: Sweep,
    curves: DecorrelationCurves,
    matcher: FrameMatcher,
    sizes: SpeckleSizes,
    reader: PairReader,
    factors: DepthFactors,
    flags: IntArray,
    pairs: SignedPairs,
    coherence: Coherence | None,
    path: FloatArray,
) -> tuple[Doubt, ...]:
    """What a sweep's own speckle says against the curves; raises if it refutes them."""
    size = speckle_size(sweep, matcher, np.flatnonzero(flags == 0), sizes)
    found = doubt_curves(size, factors, reader.sum_ratios(pairs), curves, matcher.patches, coherence)
    return unrefuted([*doubt_speed(path, sweep.frame_time_s), *found], sweep.name, MismatchError)


def doubts_of_standing(
    sweep: Sweep, matcher: FrameMatcher, curves: DecorrelationCurves, path: FloatArray, flags: IntArray
) -> tuple[Doubt, ...]:
    """Echoes that are the same in frames beyond the reach of speckle."""
    frames = far_apart(path[:, 0], flags == 0, curves)
    if len(frames) < 2:
        return ()
    share = standing_share(sweep, matcher, frames.tolist())
    found = standing(share, len(frames), float(np.median(curves.cells)), matcher.of_echo)
    return unrefuted([found], sweep.name, InsufficientDataError)


def doubts_of_path(
    sweep: Sweep,
    image: RigidTransform,
    covariance: FloatArray,
    table: CorrelationTable,
    pairs: SignedPairs,
    matcher: FrameMatcher,
    curves: DecorrelationCurves,
    flags: IntArray,
) -> tuple[Doubt, ...]:
    """A length that is open, a sweep in pieces, a path that pairs contradict."""
    z_mm, sigma_mm = image.apply(matcher.centre_mm)[:, 2], np.sqrt(covariance[:, 2, 2])
    found = (
        undetermined(z_mm, sigma_mm, float(curves.distance_mm[-1])),
        severed(pairs.first, pairs.second, flags == 0),
        folded(table, image, matcher.patches.centre_mm, flags == 0),
    )
    return unrefuted(found, sweep.name, InsufficientDataError)
