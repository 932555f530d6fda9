"""Two sweeps over the same tissue, tracked and crossed: each gives the other its length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.config import Config
from speckle3d.core.curves import BAND_ADVICE, DecorrelationCurves
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair, crossed
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.examine.sensors import credible_sensors
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.motion.direction import sensed_orientation
from speckle3d.tracked import Tracked
from speckle3d.tracked_curves import Length, corrected_curves
from speckle3d.tracking import track


def cross_sweeps(
    first: Sweep,
    second: Sweep,
    curves: DecorrelationCurves,
    config: Config | None = None,
    progress: Progress | None = None,
) -> CrossedPair:
    """Track two sweeps of one probe over the same tissue, and find the length of both where they cross.

    The geometry within images is exact: a second sweep, turned by 30 to 90 degrees about the beam, lays it
    along the first one's elevational axis.

    Parameters
    ----------
    first, second : Sweep
        Of the same probe and settings. Two parts of one recording are two sweeps, too: see `Sweep.part`.
    curves : DecorrelationCurves
        Of the probe, or of another like it: their error is found, too.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all, of both.

    Returns
    -------
    CrossedPair
        Both sweeps and how their lengths differ from the images'.

    Raises
    ------
    MismatchError, InsufficientDataError
        As `track`; or if the sweeps do not cross, overlap too little, show too little, or do not match.
    """
    settings = config or Config()
    require_pair(first, second)
    total, done = len(first) + len(second), 0
    sides = []
    for sweep in (first, second):
        stack = stack_for(sweep, settings)
        tracked = track(sweep, curves, settings, after(progress, done, total), images=stack.keep)
        sides.append(crossing_side(sweep, tracked, stack, settings))
        done += len(sweep)
    return crossed(sides[0], sides[1], settings.crossing)


def require_pair(first: Sweep, second: Sweep) -> None:
    """Check before any work that two sweeps are of the same settings and not of the same frames.

    Raises
    ------
    MismatchError
        If images or signal differ.
    InvalidInputError
        If they have frames in common.
    """
    for what, one, other in (("images", first.grid, second.grid), ("signal", first.signal, second.signal)):
        if one != other:
            advice = BAND_ADVICE if what == "signal" else ""
            raise MismatchError(
                f"{second.name}: expected the {what} of {first.name} in its crossing: {one}; got "
                f"{other}{advice}"
            )
    if first.name == second.name and np.isin(second.frame_time_s, first.frame_time_s).any():
        raise InvalidInputError(
            f"{second.name}: expected a crossing sweep with frames of its own, got some of the sweep's: give "
            "another recording, or parts that do not overlap (--frames and --crossing-frames)"
        )


def stack_for(sweep: Sweep, config: Config) -> ImageStack:
    """Where the reduced images of a sweep are to be kept while it is tracked."""
    return ImageStack(IntensityExtractor(sweep.signal, sweep.grid, config.intensity).grid)


def crossing_side(sweep: Sweep, tracked: Tracked, stack: ImageStack, config: Config) -> CrossingSweep:
    """One sweep of a crossing pair, as far as it is known before it is crossed."""
    return CrossingSweep(
        sweep.name,
        stack,
        tracked.image,
        sweep.grid.centre_mm,
        tracked.scale_sigma,
        float(tracked.shared.turn_sigma_per_mm.max()),
        sensed_orientation(credible_sensors(sweep, tracked.doubts), config.sensors),
        tracked.flags,
        sweep.frame_time_s,
    )


def curves_from(
    tracked: Sequence[Tracked], pair: CrossedPair, curves: DecorrelationCurves
) -> DecorrelationCurves:
    """Correct the curves that a crossing pair was read with by what the crossing says of its lengths.

    Parameters
    ----------
    tracked : sequence of Tracked
        The first and the second sweep.
    """
    sides = pair.first, pair.second
    lengths = [Length(side.log_scale, side.log_scale_sigma) for side in sides]
    return corrected_curves(curves, [own.curves for own in tracked], lengths)
