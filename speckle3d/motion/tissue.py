"""Adapt curves to a sweep's tissue and a scanner's processing, with the remaining errors.

Averaging of frames (persistence) widens the beam by how far the probe goes meanwhile: lengths come out short.
Where speckle has changed from one frame to the next, their mean varies less in grey: frames taken at
speed are flatter than those taken slowly, which nothing else makes of them. To first order the beam is
widened by twice the logarithm of what the grey levels' spread loses.

Filters leave structure and take speckle away. Decibels of speckle have a long tail of dark ones, filtered
they are even about their median; where bright ones have it, structure is seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.matching.quality import FrameFeatures
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import SPECKLE_SPREAD_DB, Texture
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.lens import stretched

LEAST_PAIRS = 6
"""Pairs of neighbouring frames from which averages are told."""
SINGLE_SLOPE, LEVEL = -0.1, 0.025
"""Logarithm of the grey levels' spread over correlation lost from frame to frame, in single frames at least,
and chance at which fewer are taken for averages. Of 1,400 parts of simulated sweeps of two physics, 6 to 60
frames long, 0 to 1 in a hundred are, with half of the image black up to 2; of means of two frames 38 in a
hundred are found in 6, 60 in 24 and 88 in 60 frames."""
GREY_EFFECT = 0.25
"""Relative change of distances over that of the decibels' spread, either way: by the dynamic range 0 to 0.12
over phantoms and tissue of two physics, by edge enhancement 0.1 to 0.3, by smoothing up to 0.3, by minima of
3 x 3 samples 0.3 to 0.7."""
SHORT_BY_SPREAD = 3.0
"""Length lost over what is lost of the spread: 2 to first order, simulated sweeps have 2 to 4."""
STRUCTURE_BALANCE, LEAST_OF_SPECKLE = 0.8, 0.637
"""Ratio of the distances of the 10th and the 90th percentile of decibels from their median: from which
structure's is counted, and below which structure is seen in place of speckle. Simulated speckle has 1.4 to
1.6, smoothed by 5 x 5 samples 0.85 to 1; means of many samples tend to the normal distribution's 1, maxima to
Gumbel's 0.637. A sweep of muscle and bone has 0.43, and keeps half its correlation over 2.5 times what a
sheet says."""
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
        Relative standard deviation of distances that structure in the place of speckle leaves.
    """

    curves: DecorrelationCurves
    unattenuated: DecorrelationCurves
    attenuation: Attenuation
    structure: float


def tissue_curves(curves: DecorrelationCurves, texture: Texture) -> TissueCurves:
    """Stretch curves of a phantom for a sweep's attenuation and structure."""
    attenuation = estimate_attenuation(curves, texture.spectra())
    openness = 0.0 if curves.of_tissue else structure_openness(texture)
    if openness:
        curves = replace(stretched(curves, np.array(openness)), of_tissue=True)
    # Anywhere between once and twice as much is as likely.
    return TissueCurves(attenuation.applied(curves), curves, attenuation, openness / np.sqrt(3.0))


def structure_openness(texture: Texture) -> float:
    """Logarithm of the factor by which structure may widen the curves of speckle.

    Structure only stays alike for longer: the curves' width lies between once and twice this above speckle's.
    """
    dark, bright = texture.grey_spread_db()
    if dark >= LEAST_OF_SPECKLE * bright:
        return 0.0
    return float(np.log(STRUCTURE_BALANCE / max(dark / bright, LEAST_BALANCE)))


def grey_error(signal: RFSettings | BModeSettings, texture: Texture) -> float:
    """Relative standard deviation of distances in images whose grey levels are not speckle's decibels.

    A dynamic range that is estimated, another grey map, edge enhancement and smoothing all change how far
    speckle's decibels spread to the dark and to the bright side of their median, which is known. Curves
    measured with images processed alike have it in them.
    """
    if not isinstance(signal, BModeSettings):
        return 0.0
    misfit = np.log(np.maximum(texture.grey_spread_db() / SPECKLE_SPREAD_DB, LEAST_BALANCE))
    return GREY_EFFECT * float(
        np.hypot(signal.dynamic_range_sigma_db / signal.dynamic_range_db, np.sqrt((misfit**2).mean()))
    )


def averaging_loss(table: CorrelationTable, features: Sequence[FrameFeatures]) -> float:
    """Share of the length that is lost to averaging of frames; 0 if there is none to be seen.

    Each patch tells its own slope of spread over loss; their scatter is the error of the mean.
    """
    last = table.second - table.first == 1
    spread = np.array([frame.grey_spread for frame in features])[table.second[last]]
    usable = np.median([frame.usable for frame in features], axis=0) * np.isfinite(spread).all(axis=0) > 0
    lost = 1.0 - table.median[last]
    if lost.size < LEAST_PAIRS or not usable.any():
        return 0.0
    from scipy.stats import ttest_1samp  # half a second, which RF has no need of

    faster = lost - lost.mean()
    slopes = faster @ spread[:, usable] / max(float(faster @ faster), 1e-12)
    if not ttest_1samp(slopes, SINGLE_SLOPE, alternative="less").pvalue <= LEVEL:
        return 0.0
    return float(-SHORT_BY_SPREAD * slopes.mean() * np.median(lost))
