"""Checks between the pipeline's stages: what a sweep's images, curves and sensors say against each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.sweep import Sweep
from speckle3d.correction.trust import believed, cleaned_readings, examine_sensors, without_sensors
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.standing import standing_share
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import SpeckleSizes, speckle_size
from speckle3d.motion.coherence import RowScales
from speckle3d.motion.curve_doubts import doubt_curves, doubt_speed
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.plausibility import far_apart, folded, severed, standing, undetermined
from speckle3d.motion.signs import SignedPairs


def doubts_of_curves(
    sweep: Sweep,
    curves: DecorrelationCurves,
    matcher: FrameMatcher,
    sizes: SpeckleSizes,
    reader: PairReader,
    rows: RowScales | None,
    flags: IntArray,
    pairs: SignedPairs,
    path: FloatArray,
) -> tuple[Doubt, ...]:
    """What a sweep's own speckle says against the curves; raises if it refutes them."""
    size = speckle_size(sweep, matcher, np.flatnonzero(flags == 0), sizes)
    found = doubt_curves(size, rows, reader.sum_ratios(pairs), curves, matcher.patches)
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


@dataclass(frozen=True)
class ExaminedSensors:
    """What may be used of a sweep's sensors.

    Attributes
    ----------
    trusted : Sweep
        Without the sensors that are refuted.
    telling : Sweep
        Without those, too, whose motion is not the images': they tell no sign.
    turn_confirmed : bool
        Whether roll or a gyroscope confirm how the orientation sensor turns.
    """

    trusted: Sweep
    telling: Sweep
    turn_confirmed: bool
    doubts: tuple[Doubt, ...]


def examined_sensors(
    sweep: Sweep, image: RigidTransform, covariance: FloatArray, config: Config
) -> ExaminedSensors:
    """Hold a sweep's sensors against its image-based poses, unless the configuration says not to."""
    if not config.sensors.examine:
        return ExaminedSensors(sweep, sweep, True, ())
    cleaned, doubts = cleaned_readings(sweep)
    left = believed(cleaned, doubts)
    z_mm = image.apply(sweep.grid.centre_mm)[:, 2]
    farthest = int(np.argmax(np.abs(z_mm)))
    sigma = float(np.sqrt(covariance[farthest, 2, 2])) / max(abs(float(z_mm[farthest])), 1e-9)
    trust = examine_sensors(left, image, sigma)
    trusted = believed(left, trust.doubts)
    telling = without_sensors(trusted, trust.misled)
    return ExaminedSensors(trusted, telling, trust.turn_confirmed, (*doubts, *trust.doubts))
