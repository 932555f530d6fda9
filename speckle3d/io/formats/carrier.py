"""Carrier frequency of complex samples, estimated from the phase between neighbouring samples."""

from __future__ import annotations

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import Frames

_LEAST_COHERENCE = 0.1
"""Of neighbouring samples, below which they are noise and tell nothing."""
_LEAST_SIGMAS = 4.0
"""Of the mean of so many phases of noise, below which coherence tells nothing either: of few samples."""
_FASTEST = 0.85 * np.pi
"""Turn of a carrier from sample to sample, above which it may seem to turn backwards."""
_BASEBAND, _CARRIER, _MIRROR = (-0.5, 0.3), (0.5, 1.15), (-1.15, -0.7)
"""Measured over nominal turn. Attenuation lowers a carrier, by a fifth in 40 mm of tissue and more below."""


def demodulation_of(frames: Frames, frequency_hz: float, sampling_rate_hz: float) -> float | None:
    """Frequency that complex samples were shifted down by: `frequency_hz`, or 0 where they still carry it.

    The phase between neighbouring samples is the mean turn of what they carry, the first moment of the
    spectrum [1]_: nothing, or 2 pi f / fs. The first, the middle and the last frame are looked at.

    Returns
    -------
    float or None
        None where the phase does not tell: noise, or samples too far apart for the frequency.

    Raises
    ------
    InvalidInputError
        If the carrier turns backwards: Q has the other sign.

    References
    ----------
    .. [1] C. Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
       technique", IEEE Trans. Sonics Ultrason. 32, 1985.
    """
    turn = 2.0 * np.pi * frequency_hz / sampling_rate_hz
    lag, count = 0j, 0
    for i in sorted({0, frames.shape[0] // 2, frames.shape[0] - 1}):
        frame = np.asarray(frames[i], dtype=np.complex128)
        pairs = np.conj(frame[:, :-1]) * frame[:, 1:]
        # Each pair counts the same: a near field may be a thousand times as strong as the rest.
        turns = pairs[pairs != 0] / np.abs(pairs[pairs != 0])
        lag, count = lag + turns.sum(), count + turns.size
    if turn > _FASTEST or not abs(lag) > max(_LEAST_COHERENCE * count, _LEAST_SIGMAS * count**0.5):
        return None
    share = float(np.angle(lag)) / turn
    if _MIRROR[0] <= share <= _MIRROR[1]:
        raise InvalidInputError(
            f"expected I/Q that carry {frequency_hz:g} Hz or nothing, got {share * frequency_hz:g} Hz: Q has "
            "the other sign"
        )
    if _CARRIER[0] <= share <= _CARRIER[1]:
        return 0.0
    return frequency_hz if _BASEBAND[0] <= share <= _BASEBAND[1] else None
