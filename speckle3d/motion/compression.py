"""What an estimated dynamic range leaves open of a length.

Grey levels decompressed with a range that is too wide by a share p - 1 are intensities to the power p. Those
of fully developed speckle whose correlation is rho then have, with Gauss's hypergeometric function F,

    rho_p = (F(-p, -p; 1; rho) - 1) / (F(-p, -p; 1; 1) - 1).

References
----------
.. [1] J. W. Goodman, "Speckle phenomena in optics", 2007: joint moments of intensities.
"""

from __future__ import annotations

import numpy as np
from scipy.special import hyp2f1

from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.motion.estimate import Motion
from speckle3d.motion.planes import patch_distances


def compression_sigma(motion: Motion, signal: RFSettings | BModeSettings) -> float:
    """Relative standard deviation of distances by a dynamic range that is estimated.

    One that is wider by its deviation is tried. Curves measured with images compressed alike have its error
    in them.
    """
    if motion.problem.curves.origin != "data sheet" or not isinstance(signal, BModeSettings):
        return 0.0
    power = 1.0 + signal.dynamic_range_sigma_db / signal.dynamic_range_db
    pairs = motion.pairs
    correlation = np.where(pairs.used, motion.table.correlation[pairs.row], np.float32(np.nan))
    wider = hyp2f1(-power, -power, 1.0, np.clip(correlation, 0.0, 1.0)) - 1.0
    wider = (wider / (hyp2f1(-power, -power, 1.0, 1.0) - 1.0)).astype(np.float32)
    models = motion.coherence.models(pairs.first)
    read, other = (patch_distances(motion.problem, rho, models)[0] for rho in (correlation, wider))
    return float(abs(np.nanmedian(np.log(other / read))))
