"""Track and register two crossing sweeps over the same tissue."""

from __future__ import annotations

import numpy as np

from speckle3d.config import Config
from speckle3d.core.curves import BAND_ADVICE, DecorrelationCurves
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.poses import SIDEWAYS, SIDEWAYS_BY_SHARE
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair, solve_crossing
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.examine.sensors import credible_sensors
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.motion.sensors import sensed_orientation
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
    stack = stack_for(first, settings)
    report = after(progress, 0, len(first) + len(second))
    tracking = track(first, curves, settings, report, images=stack.keep)
    return cross_with(second, first, tracking, stack, curves, settings, progress)[0]


def cross_with(
    second: Sweep,
    first: Sweep,
    tracking: Tracked,
    stack: ImageStack,
    curves: DecorrelationCurves,
    config: Config,
    progress: Progress | None = None,
) -> tuple[CrossedPair, DecorrelationCurves]:
    """Track a second sweep and cross it with a first one, which is tracked.

    Parameters
    ----------
    tracking, stack
        Of the first sweep.

    Returns
    -------
    pair : CrossedPair
    curves : DecorrelationCurves
        Corrected by the lengths of both sweeps.

    Raises
    ------
    MismatchError, InsufficientDataError
        As `cross_sweeps`.
    """
    report = after(progress, len(first), len(first) + len(second))
    second_stack = stack_for(second, config)
    second_tracking = track(second, curves, config, report, images=second_stack.keep)
    pair = solve_crossing(
        crossing_side(first, tracking, stack, config),
        crossing_side(second, second_tracking, second_stack, config),
        config.crossing,
    )
    lengths = [Length(side.log_scale, side.length_sigma) for side in (pair.first, pair.second)]
    return pair, corrected_curves(curves, [tracking.curves, second_tracking.curves], lengths)


def require_pair(first: Sweep, second: Sweep) -> None:
    """Check before any work that two sweeps are of the same settings and not of the same frames.

    Raises
    ------
    MismatchError
        If images or signal differ.
    InvalidInputError
        If they have frames in common.
    """
    pairs = ("images", first.grid, second.grid, ""), ("signal", first.signal, second.signal, BAND_ADVICE)
    for noun, of_first, of_second, advice in pairs:
        if of_first != of_second:
            raise MismatchError(
                f"{second.name}: expected the {noun} of {first.name} in its crossing: {of_first}; got "
                f"{of_second}{advice}"
            )
    if first.name == second.name and np.isin(second.frame_time_s, first.frame_time_s).any():
        raise InvalidInputError(
            f"{second.name}: expected a crossing sweep with frames of its own, got some of the sweep's: give "
            "another recording, or parts that do not overlap (--frames and --crossing-frames)"
        )


def stack_for(sweep: Sweep, config: Config) -> ImageStack:
    """Make the empty stack that keeps a sweep's reduced images while it is tracked."""
    return ImageStack(IntensityExtractor(sweep.signal, sweep.grid, config.intensity).grid)


def crossing_side(sweep: Sweep, tracking: Tracked, stack: ImageStack, config: Config) -> CrossingSweep:
    """Describe one sweep of a crossing pair by what tracking it alone gives."""
    return CrossingSweep(
        sweep.name,
        stack,
        tracking.image,
        sweep.grid.centre_mm,
        tracking.scale_sigma,
        float(tracking.shared.turn_sigma_per_mm.max()),
        sensed_orientation(credible_sensors(sweep, tracking.doubts), config.sensors),
        tracking.flags,
        sweep.frame_time_s,
        float((SIDEWAYS + SIDEWAYS_BY_SHARE * tracking.coherence.share.mean())[0]),
    )
