"""Numbers, frames and grey levels of HDF5 files of others, whose shapes differ by who wrote them."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import h5py
import numpy as np

from speckle3d.core.arrays import AnyArray, ComplexArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import Frames
from speckle3d.io.frames import FileFrames, HDF5Slices
from speckle3d.io.hdf5 import has_member, locate, read_array
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.recordings import Value, rate_by_spacing, step_of

Turn = Callable[..., AnyArray]
"""Makes a frame (vector, sample) of slices of data sets."""

ENVELOPE_RANGE_DB = 80.0
"""Of grey levels made here unless another is given: 0.31 dB a level, while speckle itself spreads by 5.6
dB."""


TOLERANCE_MM = 1e-3
"""Of a pixel's place: single precision in metres keeps 1e-5 mm of a depth of 150 mm."""

_LEAST_COHERENCE = 0.1
"""Of neighbouring samples, below which they are noise and tell nothing."""
_LEAST_SIGMAS = 4.0
"""Of the mean of so many phases of noise, below which coherence tells nothing either: of few samples."""
_FASTEST = 0.85 * np.pi
"""Turn of a carrier from sample to sample, above which it may seem to turn backwards."""
_BASEBAND, _CARRIER, _MIRROR = (-0.5, 0.3), (0.5, 1.15), (-1.15, -0.7)
"""Measured over nominal turn. Attenuation lowers a carrier, by a fifth in 40 mm of tissue and more below."""


def single(group: h5py.Group, name: str) -> float | None:
    """Read one number; None if there is none, or an empty array, of this name.

    Raises
    ------
    InvalidInputError
        If there are several that differ, as one per transmission may.
    """
    values = read_array(group, name, None).ravel() if has_member(group, name) else np.zeros(0)
    if values.size and np.ptp(values):
        raise InvalidInputError(
            f"{locate(group, name)}: expected one number, got {values.min():g} to {values.max():g}"
        )
    return float(values[0]) if values.size else None


def values_of(group: h5py.Group, places: Mapping[str, str]) -> dict[str, Value]:
    """Read the numbers of a file that are there and not 0, by the names of their settings.

    A bandwidth is a share of the centre frequency, or in percent of it where its name says so.
    """
    values = dict[str, Value]()
    for name, place in places.items():
        if number := single(group, place):
            values[name] = Value(number, f"in {group[place].name[1:]}")
    if (band := values.pop("bandwidth_hz", None)) and (centre := values.get("centre_frequency_hz")):
        half = band.value / (200 if "percent" in band.source else 2)
        edges = centre.value * (1 - half), centre.value * (1 + half)
        values["bandwidth_hz"] = replace(band, value=edges)
    return values


def by_phase(
    frames: FileFrames,
    carrier_hz: float,
    stated: Value,
    values: Mapping[str, Value],
    settings: ImportSettings,
) -> Value:
    """Frequency that I/Q were shifted down by: `carrier_hz` or 0 as their phase tells, else as stated."""
    if settings.demodulation_frequency_hz is not None:
        return stated
    rate_hz = rate_by_spacing(values["row_spacing_mm"], settings, values).value
    shift_hz = demodulation_of(frames, carrier_hz, rate_hz)
    if shift_hz in (None, stated.value):
        return stated
    if stated.value is not None:
        words = f"I/Q are shifted by {shift_hz:g} Hz as their phase tells, the file says {stated.value:g}"
        warnings.warn(f"{frames.path}: {words}: --demodulation-frequency-hz decides", stacklevel=2)
    return Value(shift_hz, f"{stated.source} and the phase of the data")


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


def pixel_values(place: ComplexArray, where: str, source: str) -> dict[str, Value] | None:
    """Numbers of a Cartesian or polar grid, by the places of its pixels; None if they lie on neither.

    Parameters
    ----------
    place : ndarray of complex, shape (line, sample)
        Depth + i x lateral position, mm.

    Raises
    ------
    InvalidInputError
        If lines or samples are not evenly spaced.
    """

    def is_zero(off: ComplexArray) -> bool:
        return bool(np.abs(off).max() <= TOLERANCE_MM)

    if not (place.size and np.isfinite(place).all()):
        raise InvalidInputError(f"{where}: expected finite places of pixels, got others")
    numbers: dict[str, Any]
    x_mm, z_mm = place[:, 0].imag, place[0].real
    angle = np.angle(place[:, -1] - place[:, 0])
    along = np.exp(1j * angle)
    if is_zero(place - (z_mm + 1j * x_mm[:, None])):
        numbers = {"vector_pitch_mm": step_of(x_mm, f"{where}, x"), "first_sample_depth_mm": float(z_mm[0])}
    elif not np.ptp(angle):
        return None
    else:
        # Lines meet where the distance from all of them is least.
        normals = np.column_stack([-along.imag, along.real])
        apex = np.linalg.lstsq(normals, (place[:, 0] * along.conj()).imag)[0] @ [1, 1j]
        z_mm = np.abs(place[0] - apex)
        if not is_zero(place - apex - np.outer(along, z_mm)):
            return None
        step_of(angle, f"{where}, angles of the lines")
        array_mm = max(0.0, round(-float(apex.real), 6))
        ends = tuple(np.rad2deg(angle[[0, -1]]).tolist())
        numbers = {"array_radius_mm": array_mm, "line_angles_deg": ends}
        numbers["first_sample_depth_mm"] = float(z_mm[0]) - array_mm
    numbers["row_spacing_mm"] = step_of(z_mm, f"{where}, depths")
    return {name: Value(value, source) for name, value in numbers.items()}


def frame_of(*parts: AnyArray, shape: tuple[int, ...], across: bool = False, pairs: bool = False) -> AnyArray:
    """Turn numbers of a frame, in one array or in real and imaginary parts, into (vector, sample).

    Parameters
    ----------
    shape : tuple of int
        Vectors and samples of a frame.
    across : bool
        Whether the vectors run fastest in the file, and not the samples.
    pairs : bool
        Whether the last axis is I and Q.
    """
    if pairs:
        parts = parts[0][..., 0], parts[0][..., 1]
    elif parts[0].dtype.names:
        parts = parts[0]["real"], parts[0]["imag"]
    frame, *imaginary = (part.reshape(shape[::-1]).T if across else part.reshape(shape) for part in parts)
    return frame + np.complex64(1j) * imaginary[0] if imaginary else frame


def grey_levels(
    *parts: AnyArray, turn: Turn, decibels: bool, top: float, dynamic_range_db: float
) -> AnyArray:
    """Turn decibels, or an echo's amplitude, into grey levels, 255 at `top`, 0 that range below."""
    values = turn(*parts).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        below = values - top if decibels else 20.0 * np.log10(values / top)
    if np.isnan(below).any():
        raise InvalidInputError("expected echoes' amplitudes, got NaN or a negative one")
    return np.rint(np.clip(255.0 * (1.0 + below / dynamic_range_db), 0.0, 255.0)).astype(np.uint8)


def grey_frames(
    source: HDF5Slices, shape: tuple[int, int, int], decibels: bool, dynamic_range_db: float | None
) -> tuple[FileFrames, Value]:
    """Frames of grey levels and their dynamic range; all frames are read once to find the strongest echo."""
    read, span = source(), dynamic_range_db or ENVELOPE_RANGE_DB
    top = max((float(read(i).max()) for i in range(shape[0])), default=0.0)
    if not (np.isfinite(top) and (decibels or top > 0)):
        raise InvalidInputError(f"expected echoes, got amplitudes up to {top:g}")
    turn = partial(grey_levels, turn=source.turn, decibels=decibels, top=top, dynamic_range_db=span)
    frames = FileFrames(source.path, replace(source, turn=turn), shape, np.uint8)
    return frames, Value(span, f"of grey levels made here below {top:g}")
