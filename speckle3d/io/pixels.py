"""Pixels of an image sequence to frames of samples: PLUS's image types and orientations."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.io.headers import SequenceHeader

RF_TYPES = ("RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE")


def image_type(header: SequenceHeader) -> str:
    """PLUS's image type, told from the pixels where the header does not say."""
    named = header.fields.get("UltrasoundImageType")
    if named is not None:
        return named
    pixel = header.fields.get("ElementType") or header.fields.get("type", "")
    return "BRIGHTNESS" if pixel in ("MET_UCHAR", "uint8", "unsigned char", "uchar") else "RF_REAL"


def image_orientation(header: SequenceHeader) -> str:
    """PLUS's image orientation, its defaults where the header does not say: MF for B-mode, FM for RF."""
    default = "FM" if image_type(header) in RF_TYPES else "MF"
    return header.fields.get("UltrasoundImageOrientation", default).upper()


def read_pixels(header: SequenceHeader) -> npt.NDArray[Any]:
    """Pixels as (frame, second axis, first axis)."""
    import SimpleITK

    try:
        # Named, because the library otherwise believes the file's suffix.
        image = SimpleITK.ReadImage(header.path, imageIO=f"{header.file_format}IO")
    except RuntimeError as error:
        raise FileError(f"{header.path}: cannot be read: {str(error).strip().splitlines()[-1]}") from error
    pixels = SimpleITK.GetArrayFromImage(image)
    expected = (header.frame_count, header.size[1], header.size[0])
    if "list" in header.fields.get("kinds", "") and pixels.shape == (*expected[1:], expected[0]):
        pixels = np.moveaxis(pixels, -1, 0)  # an NRRD list of frames arrives as one image of many components
    if pixels.shape not in (expected, expected[1:]):
        raise InvalidInputError(f"{header.path}: expected grey pixels {expected}, got {pixels.shape}")
    return pixels.reshape(expected)


def to_samples(header: SequenceHeader, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Turn pixels into frames (frame, vector, sample): marked side last, far side last.

    Returns
    -------
    ndarray
        uint8 for B-mode, int16 or float32 for RF, complex64 for I and Q.
    """
    kind = image_type(header)
    orientation = image_orientation(header)
    if kind not in (*RF_TYPES, "BRIGHTNESS"):
        raise InvalidInputError(f"{header.path}: expected a grey B-mode or RF image, got type {kind}")
    if kind == "BRIGHTNESS":
        if pixels.dtype != np.uint8:
            raise InvalidInputError(f"{header.path}: expected B-mode of type uint8, got {pixels.dtype}")
        return _oriented(header.path, pixels, orientation)
    if kind == "RF_REAL":
        return _oriented(header.path, _narrowed(pixels), orientation)
    frames = _oriented(header.path, _analytic(header.path, pixels, orientation, kind), orientation)
    return _positive_carrier(frames)


def _oriented(path: str, pixels: npt.NDArray[Any], orientation: str) -> npt.NDArray[Any]:
    """Turn (frame, y, x) into (frame, vector, sample), marked side last, far side last."""
    x, y = (*orientation, "", "")[:2]
    if not ((x in "MU" and y in "FN") or (x in "FN" and y in "MU")) or not (x and y):
        raise InvalidInputError(
            f"{path}: UltrasoundImageOrientation: expected as MF or FM, got {orientation}"
        )
    if x in "MU":
        pixels, x, y = pixels.transpose(0, 2, 1), y, x
    if x == "N":
        pixels = pixels[:, :, ::-1]
    if y == "U":
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _narrowed(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """RF as int16 where that loses nothing, else as float32."""
    limits = np.iinfo(np.int16)
    if pixels.dtype.kind in "iu" and pixels.min() >= limits.min and pixels.max() <= limits.max:
        return pixels.astype(np.int16, copy=False)
    return pixels.astype(np.float32)


def _analytic(path: str, pixels: npt.NDArray[Any], orientation: str, kind: str) -> npt.NDArray[np.complex64]:
    axis = 2 if orientation.startswith(("F", "N")) else 1
    if kind == "RF_I_LINE_Q_LINE":
        axis = 3 - axis
    if pixels.shape[axis] % 2:
        raise InvalidInputError(f"{path}: expected I and Q in pairs, got {pixels.shape[axis]}")
    in_phase, quadrature = np.moveaxis(pixels, axis, 0)[0::2], np.moveaxis(pixels, axis, 0)[1::2]
    analytic = (in_phase + 1j * quadrature).astype(np.complex64)
    return np.moveaxis(analytic, 0, axis)


def _positive_carrier(frames: npt.NDArray[np.complex64]) -> npt.NDArray[np.complex64]:
    """Conjugate where the carrier turns backwards, as it does in a reversed line or with the other sign of Q.

    The phase between neighbouring samples is the carrier's mean turn, the first moment of the spectrum [1]_.

    References
    ----------
    .. [1] C. Kasai et al., "Real-time two-dimensional blood flow imaging using an autocorrelation
       technique", IEEE Trans. Sonics Ultrason. 32, 1985.
    """
    first = frames[0]
    turn = np.angle(np.vdot(first[:, :-1], first[:, 1:]))
    return np.conj(frames) if turn < 0 else frames
