"""What a package says of one thing in two ways: depth and samples, rate and times.

The samples of every recording at hand make up the imaging depth to 1.3 %, so that a sampling rate that is
not the data's is seen. What is refused is what no good file can be: samples that reach beyond 1.5 x the
imaging depth, or, of an envelope or a file called I/Q, which hold all of the image, below 0.6 x. RF may be
cropped to a region of interest: however shallow, it is told, not refused. So is all that is 10 % off.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.clarius.lines import BEFORE_DEPTH_S
from speckle3d.io.clarius.sidecars import Description
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings

_DEEPEST, _SHALLOWEST = 1.5, 0.6
_TOLD = 0.1

_OFF_RATE = 10.0
"""RF comes with every third frame or so, and the rate is not constant; a wrong unit of time is 1000."""

_INTERVALS = 8
"""Fewer may all be slow: a recording at hand begins with pauses of half a second."""

_LONGEST_S = 60.0


def require_times(where: str, said: Description, times_ns: npt.NDArray[np.int64]) -> None:
    """Refuse frame times that are not those of a recording at the yml's frame rate.

    Raises
    ------
    InvalidInputError
        Naming the frame, its interval, and what was expected.
    """
    steps_s = np.diff(times_ns) / 1e9
    if not steps_s.size:
        return
    if (far := np.flatnonzero(steps_s > _LONGEST_S)).size:
        raise InvalidInputError(
            f"{where}: frame {far[0] + 1}: expected a time within {_LONGEST_S:g} s of the frame before, got "
            f"{steps_s[far[0]]:.6g} s"
        )
    if not said.frame_rate_hz:
        return
    expected_s, median_s = 1 / said.frame_rate_hz, float(np.median(steps_s))
    too_slow = steps_s.size >= _INTERVALS and median_s > _OFF_RATE * expected_s
    if too_slow or median_s < expected_s / _OFF_RATE:
        i = int(np.argmin(np.abs(steps_s - median_s)))
        raise InvalidInputError(
            f"{where}: frame {i + 1}: expected about {expected_s:.4g} s after the frame before, by the frame "
            f"rate of {said.frame_rate_hz:g} Hz in the yml, got {steps_s[i]:.4g} s, and {median_s:.4g} s "
            "between most: times of another unit"
        )


def require_depth(name: str, said: Description, settings: ImportSettings) -> None:
    """Refuse a sampling rate or a delay that the imaging depth contradicts.

    Parameters
    ----------
    name : str
        What the raw file is called, of `KINDS`: ``rf`` may be cropped in depth.

    Raises
    ------
    InvalidInputError
        With both depths, and the option that replaces what is wrong.
    """
    delay, depth_mm = said.delay_samples, said.imaging_depth_mm
    if delay is not None and settings.first_sample_depth_mm is None:
        start_mm = _start_mm(delay, said, settings)
        if delay < 0 or (depth_mm is not None and start_mm > depth_mm):
            most = "" if depth_mm is None else f" to less than the imaging depth of {depth_mm:g} mm"
            raise InvalidInputError(
                f"{said.where}: delay samples: expected from 0{most}, got {delay:g} samples, which "
                f"begin at {start_mm:.4g} mm: --first-sample-depth-mm replaces it"
            )
    if depth_mm is None or settings.sampling_rate_hz is not None:
        return
    low_mm, high_mm = _reaches_mm(said, settings)
    full = said.kind == "envelope" or name == "iq"
    if low_mm > _DEEPEST * depth_mm or (full and high_mm < _SHALLOWEST * depth_mm):
        raise InvalidInputError(
            f"{said.where}: sampling rate: expected samples that reach the imaging depth of {depth_mm:g} mm, "
            f"got {said.samples} that reach {high_mm:.4g} mm at {said.sampling_rate_hz / 1e6:g} MHz: "
            "--sampling-rate-hz replaces it, or says that it is right"
        )


def depth_notes(said: Description, settings: ImportSettings) -> list[str]:
    """Tell a depth of the samples that is 10 % off the imaging depth."""
    depth_mm = said.imaging_depth_mm
    low_mm, high_mm = _reaches_mm(said, settings)
    if depth_mm is None or (low_mm <= (1 + _TOLD) * depth_mm and high_mm >= (1 - _TOLD) * depth_mm):
        return []
    return [
        f"the samples reach {high_mm:.4g} mm, and the imaging depth in the yml is {depth_mm:g} mm: the "
        "region of interest is another, or the sampling rate"
    ]


def _spacing_mm(said: Description, settings: ImportSettings) -> float:
    speed = settings.speed_of_sound_m_s or said.speed_of_sound_m_s or SPEED_OF_SOUND_M_S
    return speed * 1e3 / (2 * (settings.sampling_rate_hz or said.sampling_rate_hz))


def _start_mm(delay: float, said: Description, settings: ImportSettings) -> float:
    rate_hz = settings.sampling_rate_hz or said.sampling_rate_hz
    return (delay - BEFORE_DEPTH_S * rate_hz) * _spacing_mm(said, settings)


def _reaches_mm(said: Description, settings: ImportSettings) -> tuple[float, float]:
    """Depth of the end of the region of interest, and of the samples."""
    start_mm = settings.first_sample_depth_mm
    if start_mm is None:
        start_mm = max(_start_mm(said.delay_samples or 0.0, said, settings), 0.0)
    ends = (said.samples if said.roi is None else said.roi.end_sample + 1, said.samples)
    low, high = (start_mm + end * _spacing_mm(said, settings) for end in ends)
    return low, high
