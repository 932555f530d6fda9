"""Adapt curves to a sweep's tissue and a scanner's processing, with the remaining errors.

Averaging of frames (persistence) widens the beam by what the probe goes meanwhile, so that lengths come out
short. Where speckle has changed from one frame to the next, their mean varies less in grey: frames taken at
speed are flatter than those taken slowly, which nothing else makes of them. To first order the beam is
widened by twice the logarithm of what the grey levels' spread loses.

Filters leave structure and take speckle away. Decibels of speckle have a long tail of dark ones, filtered
they are even about their median; where bright ones have the long tail, it is structure that is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import theilslopes

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.matching.quality import FrameFeatures
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import Texture
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.lens import stretched

SMOOTHED = 21
"""Frames over which tissue goes by: what changes more slowly is no effect of speed."""
USABLE_SHARE = 0.8
"""Of the frames in which a patch must be usable to be compared from frame to frame."""
LEAST_FRAMES = 24
"""Pairs of neighbouring frames. With 12 to 16, three to six in a hundred single ones fall as steeply by
chance, half of a sweep over bone among them, and two of three means of two frames do not."""
AVERAGED_SLOPE = -0.25
"""Logarithm of the grey levels' spread over correlation lost from frame to frame, below which frames are
averages. Simulated sweeps of two physics have -0.21 to 0.1; means of two frames -0.37 to -0.7, of three -0.5
to -1.4, half of the last frame kept -1.1 to -1.8; bone at 0.5 mm a frame -0.16."""
RANGE_EFFECT = 0.2
"""Relative change of distances over that of the dynamic range, either way: phantom and tissue of two physics
at 40, 60 and 80 dB have 0 to 0.12, smoothed by 3 x 3 and 5 x 5 samples up to 0.2."""
CONFIDENCE = 0.9
"""Of the slope's interval, which must end below zero: with -0.1, the median of single frames, fewer images
black on one side are taken for averages (6 of 100 for 12), and one mean of two frames in four is missed."""
SHORT_BY_SPREAD = 3.0
"""Length lost over what is lost of the spread: 2 to first order, simulated sweeps have 2 to 4."""
STRUCTURE_BALANCE = 0.8
"""Ratio of the distances of the 10th and the 90th percentile of decibels from their median, below which
structure is seen in place of speckle. Simulated speckle has 1.4 to 1.6, smoothed by 5 x 5 samples 0.85 to 1;
a sweep of muscle and bone has 0.43, and keeps half its correlation over 2.5 times what a sheet says."""
LEAST_BALANCE = 0.1
"""Taken where it is less: zero where a tenth of the samples and the median have one grey level, as in images
that are black for the most part, or of four levels. Lengths are then open by a factor of 64."""


@dataclass(frozen=True)
class TissueCurves:
    """Curves adapted to a sweep's tissue.

    Attributes
    ----------
    curves : DecorrelationCurves
    unattenuated : DecorrelationCurves
        The same, stretched for structure alone.
    attenuation : Attenuation
        Of the tissue over the curves' phantom.
    structure : float
        Logarithm of the factor by which they were stretched for structure in the place of speckle.
    """

    curves: DecorrelationCurves
    unattenuated: DecorrelationCurves
    attenuation: Attenuation
    structure: float


def tissue_curves(curves: DecorrelationCurves, texture: Texture) -> TissueCurves:
    """Stretch curves of a phantom for a sweep's attenuation and structure."""
    attenuation = estimate_attenuation(curves, texture.spectra())
    structure = 0.0 if curves.of_tissue else structure_openness(texture)
    if structure:
        curves = replace(stretched(curves, np.array(structure)), of_tissue=True)
    return TissueCurves(attenuation.applied(curves), curves, attenuation, structure)


def structure_openness(texture: Texture) -> float:
    """Logarithm of the factor by which structure may widen the curves of speckle.

    Structure only stays alike for longer: the curves' width lies between once and twice this above speckle's.
    """
    return float(np.log(max(1.0, STRUCTURE_BALANCE / max(texture.balance(), LEAST_BALANCE))))


def compression_error(signal: RFSettings | BModeSettings) -> float:
    """Relative standard deviation of distances in images whose dynamic range is estimated.

    Curves measured with images compressed alike have it in them.
    """
    if not isinstance(signal, BModeSettings):
        return 0.0
    return RANGE_EFFECT * signal.dynamic_range_sigma_db / signal.dynamic_range_db


def averaging_loss(table: CorrelationTable, features: Sequence[FrameFeatures]) -> float:
    """Share of the length that is lost to averaging of frames; 0 if there is none to be seen."""
    spread = np.array([frame.grey_spread for frame in features])
    usable = np.mean([frame.usable for frame in features], axis=0) >= USABLE_SHARE
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
