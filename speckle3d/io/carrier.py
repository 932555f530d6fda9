"""Whether complex samples still carry their frequency, told by how their phase turns along depth."""

from __future__ import annotations

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import Frames

_LEAST_COHERENCE = 0.1
"""Of neighbouring samples, below which they are noise and tell nothing."""
_CLOSER = 0.5
"""How much closer the phase must be to one answer than to the others: attenuation lowers a carrier by a
fifth."""


def demodulation_of(frames: Frames, frequency_hz: float, sampling_rate_hz: float) -> float | None:
    """Frequency that complex samples were shifted down by: `frequency_hz`, or 0 where they still carry it.

    The phase between neighbouring samples is the mean turn of what they carry, the first moment of the
    spectrum [1]_: nothing, or 2 pi f / fs.

    Returns
    -------
    float or None
        None where the phase does not tell: noise, or a carrier that turns by about a whole circle.

    Raises
    ------
    InvalidInputError
        If the carrier turns backwards: Q has the other sign.

    References
    ----------
    .. [1] C. Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
       technique", IEEE Trans. Sonics Ultrason. 32, 1985.
    """
    lag, power = 0j, 0.0
    for i in sorted({0, frames.shape[0] // 2, frames.shape[0] - 1}):
        frame = np.asarray(frames[i], dtype=np.complex128)
        lag += complex(np.vdot(frame[:, :-1], frame[:, 1:]))
        power += float((np.abs(frame) ** 2).sum())
    if not abs(lag) > _LEAST_COHERENCE * power:
        return None
    carried = 2.0 * np.pi * frequency_hz / sampling_rate_hz
    none, forward, backward = (
        float(abs(np.angle(lag * np.exp(-1j * turn)))) for turn in (0.0, carried, -carried)
    )
    if none < _CLOSER * min(forward, backward):
        return frequency_hz
    if forward < _CLOSER * min(none, backward):
        return 0.0
    if backward < _CLOSER * min(none, forward):
        raise InvalidInputError(
            f"expected I/Q whose phase turns by {carried:.2f} rad a sample, or by none, got "
            f"{np.angle(lag):.2f}: Q has the other sign"
        )
    return None
