"""What a scanner makes of its echoes before they are images, and what that leaves open of a length.

Averaging of frames (persistence) widens the beam by what the probe goes meanwhile, so that lengths come out
short. Where speckle has changed from one frame to the next, their mean varies less in grey: frames taken at
speed are flatter than those taken slowly, which nothing else makes of them. To first order the beam is
widened by twice the logarithm of what the grey levels' spread loses.

Filters leave structure and take speckle away. Decibels of speckle have a long tail of dark ones, filtered
they are even about their median; where bright ones have the long tail, it is structure that is seen.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import theilslopes

from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.matching.frames import MatchedSweep
from speckle3d.matching.texture import Texture

SMOOTHED = 21
"""Frames over which tissue goes by: what changes more slowly is no effect of speed."""
USABLE_SHARE = 0.8
"""Of the frames in which a patch must be usable to be compared from frame to frame."""
LEAST_FRAMES = 24
"""Pairs of neighbouring frames: of parts of simulated sweeps with fewer, one in twenty falls as steeply by
chance, and most means of two frames do not."""
AVERAGED_SLOPE = -0.25
"""Logarithm of the grey levels' spread over correlation lost from frame to frame, below which frames are
averages. Simulated sweeps of two physics have -0.21 to 0.1; means of two frames -0.37 to -0.7, of three -0.5
to -1.4, half of the last frame kept -1.1 to -1.8; bone at 0.5 mm a frame -0.16."""
CONFIDENCE = 0.9
SHORT_BY_SPREAD = 3.0
"""Length lost over what is lost of the spread: 2 to first order, simulated sweeps have 2 to 4."""
SHORT_REFUSED = 0.03
"""Of the length, from which averaging refuses it: the share is known to a factor of two."""
STRUCTURE_BALANCE = 0.8
"""Ratio of the distances of the 10th and the 90th percentile of decibels from their median, below which
structure is seen in place of speckle. Simulated speckle has 1.4 to 1.6, smoothed by 5 x 5 samples 0.85 to 1;
a sweep of muscle and bone has 0.43, and keeps half its correlation over 2.5 times what a sheet says."""
LEAST_BALANCE = 0.1
"""Taken where it is less: zero where a tenth of the samples and the median have one grey level, as in images
that are black for the most part, or of four levels. Lengths are then open by a factor of 64."""


def structure_openness(texture: Texture) -> float:
    """How much wider than speckle's curves those of a sweep that shows structure may be, as a logarithm.

    Structure only stays alike for longer: the curves' width lies between once and twice this above speckle's.
    """
    return float(np.log(max(1.0, STRUCTURE_BALANCE / max(texture.balance(), LEAST_BALANCE))))


def processing_doubts(structure: float, short: float) -> tuple[Doubt, ...]:
    """What tells that images are not speckle alone, or not of one moment each."""
    doubts = []
    if short > 0.0:
        evidence = (
            "expected grey levels that vary as much at speed as at rest, got frames that are means of "
            f"several (persistence, frame averaging): lengths come out some {short:.0%} short"
        )
        doubts.append(Doubt("images", "averaged frames", evidence, short > SHORT_REFUSED))
    if structure > 0.0:
        evidence = (
            "expected grey levels of speckle, got those of structure, which stays alike for longer: lengths "
            f"are open by a factor of {np.exp(2 * structure):.1f}; curves of a tracked sweep know it"
        )
        doubts.append(Doubt("images", "filtered images", evidence, False))
    return tuple(doubts)


def shortening(matches: MatchedSweep) -> float:
    """Share of the length that is lost to averaging of frames; 0 if there is none to be seen."""
    spread = np.array([frame.grey_spread for frame in matches.features])
    usable = np.mean([frame.usable for frame in matches.features], axis=0) >= USABLE_SHARE
    table = matches.table
    last = table.second - table.first == 1
    frames = table.second[last]
    if not usable.any() or frames.size < LEAST_FRAMES or not np.isfinite(spread[:, usable]).all():
        return 0.0
    lost, level = 1.0 - table.median[last], spread[frames][:, usable].mean(axis=1)
    slope, _, _, high = theilslopes(_changes(level), _changes(lost), CONFIDENCE)
    if slope > AVERAGED_SLOPE or high > 0.0:
        return 0.0
    return float(-SHORT_BY_SPREAD * slope * np.median(lost))


def _changes(values: FloatArray) -> FloatArray:
    """Values over their mean about each frame."""
    return np.asarray(values - uniform_filter1d(values, SMOOTHED))
