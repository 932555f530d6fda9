"""The frequency that I/Q were shifted down by, and I/Q as if it had been the same at all depths.

The scanner's demodulation frequency falls along a straight line from depth 0 to the filter's depth, as from
11 to 8 MHz [1]_; ``focus: receive:`` of newer yml files gives both ends. A sweep has one frequency. Samples
are turned as if the oscillator had stayed at that of the line's middle, which takes the oscillator's phase
to be the integral of its frequency: so it is where a frequency is swept, but it is not documented. Left as
they are, echoes would lie elsewhere in the band at every depth: simulated I/Q shifted down by 9 to 6 MHz
gave lengths 10 % off, and turned back 0.001 % from those of RF. A frequency wrong by 0.7 of 7.5 MHz gave 6
%: it is asked for where the yml does not say. `measured_centres_hz` shows what contradicts it, or Q of the
other sign.

References
----------
.. [1] clariusdev/research, "Low-Level Parameters" (docs/low-level-parameters.md): `rxFreqShallow`, "start
   demodulation frequency", and `rxFreqDeep`.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.io.clarius.sidecars import Receive


def middle_hz(receive: Receive, depth_mm: FloatArray) -> float:
    """Demodulation frequency in the middle of a line whose samples lie at `depth_mm`."""
    return receive.at_hz(float(depth_mm[0] + depth_mm[-1]) / 2)


def turns_to(
    frequency_hz: float, receive: Receive, depth_mm: FloatArray, sampling_rate_hz: float
) -> ComplexArray | None:
    """Factors that make I/Q as if shifted down by one frequency.

    Parameters
    ----------
    depth_mm : ndarray, shape (sample,)

    Returns
    -------
    ndarray, shape (sample,), or None
        Of magnitude one; None where that frequency it was.
    """
    apart = np.array([receive.at_hz(each) for each in depth_mm]) - frequency_hz
    if not apart.any():
        return None
    cycles = np.concatenate([[0.0], np.cumsum((apart[1:] + apart[:-1]) / 2)]) / sampling_rate_hz
    return np.asarray(np.exp(2j * np.pi * cycles))
