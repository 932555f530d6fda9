"""How the pixels of a PLUS image are laid out, and turning them to vectors and samples and back.

PLUS's orientations name where the first and the second axis of an image lead: to the marked (M) or unmarked
(U) side of the probe, far from (F) or near to (N) it [1]_.

References
----------
.. [1] PLUS user manual, "Ultrasound image orientation".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.headers import SequenceHeader

RF_TYPES = ("RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE")
_THIRD_AXES = ("", "A", "D")
"""Of a third letter: ascending or descending, which of an image of two axes says nothing."""
_PAIRED = RF_TYPES[1:]


@dataclass(frozen=True)
class Layout:
    """Layout of one image.

    Attributes
    ----------
    kind : str
        PLUS's image type: BRIGHTNESS, RF_REAL, RF_IQ_LINE (I and Q in turn along a line) or RF_I_LINE_Q_LINE
        (a line of I, a line of Q).
    orientation : str
        As MF: columns to the marked side, rows away from the probe.
    """

    kind: str
    orientation: str

    @property
    def is_rf(self) -> bool:
        """Whether samples are radio-frequency ones, real or I and Q."""
        return self.kind in RF_TYPES

    @property
    def is_complex(self) -> bool:
        """Whether samples are I and Q."""
        return self.kind in _PAIRED

    @property
    def has_lines_in_rows(self) -> bool:
        """Whether depth grows, or shrinks, along the first axis."""
        return self.orientation.startswith(("F", "N"))

    def check(self, path: str, size: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Refuse images that are no ultrasound lines.

        Raises
        ------
        InvalidInputError
        """
        if self.kind not in (*RF_TYPES, "BRIGHTNESS"):
            raise InvalidInputError(f"{path}: expected a grey B-mode or RF image, got type {self.kind}")
        if self.kind == "BRIGHTNESS" and dtype != np.uint8:
            raise InvalidInputError(f"{path}: expected B-mode of type uint8, got {dtype}")
        sides = {*self.orientation[:2]}
        if (
            sides not in ({"M", "F"}, {"M", "N"}, {"U", "F"}, {"U", "N"})
            or self.orientation[2:] not in _THIRD_AXES
        ):
            raise InvalidInputError(
                f"{path}: UltrasoundImageOrientation: expected as MF, FM or MFA, got {self.orientation}"
            )
        if self.is_complex and size[1 - self._pair_axis] % 2:
            raise InvalidInputError(f"{path}: expected I and Q in pairs, got {size[1 - self._pair_axis]}")

    def frame(self, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn pixels, shape (y, x), into samples, shape (vector, sample): marked and far sides last."""
        if self.is_complex:
            pixels = _joined(pixels, self._pair_axis)
        return np.ascontiguousarray(self._flipped(pixels if self.has_lines_in_rows else pixels.T))

    def pixels(self, frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn samples, shape (vector, sample), into pixels, shape (y, x): what `frame` undoes."""
        flipped = self._flipped(frame)
        turned = flipped if self.has_lines_in_rows else flipped.T
        return np.ascontiguousarray(_parted(turned, self._pair_axis) if self.is_complex else turned)

    def shape(self, size: tuple[int, ...]) -> tuple[int, int]:
        """Vectors and samples of an image of a size (x, y)."""
        y, x = (
            n // 2 if self.is_complex and self._pair_axis == axis else n
            for axis, n in ((0, size[1]), (1, size[0]))
        )
        return (y, x) if self.has_lines_in_rows else (x, y)

    @property
    def _pair_axis(self) -> int:
        """Axis of (y, x) along which I and Q alternate."""
        depth = 1 if self.has_lines_in_rows else 0
        return depth if self.kind == "RF_IQ_LINE" else 1 - depth

    def _flipped(self, frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Turn lines round, and their order; shape (vector, sample) in and out."""
        frame = frame[:, ::-1] if "N" in self.orientation[:2] else frame
        return frame[::-1] if "U" in self.orientation[:2] else frame


def layout_of(header: SequenceHeader, orientation: str | None = None) -> Layout:
    """Tell an image's layout; PLUS's own where the header does not say, or `orientation` if given.

    PLUS stores B-mode as MF and RF as FM unless the header names another orientation.
    """
    kind = image_type(header)
    usual = "FM" if kind in RF_TYPES else "MF"
    # A machine's orientation is of one kind of its images, those whose lines run as they usually do.
    is_of_kind = orientation is not None and (orientation[:1].upper() in "FN") == (usual == "FM")
    default = orientation if orientation is not None and is_of_kind else usual
    return Layout(kind, header.fields.get("UltrasoundImageOrientation", default).upper())


def image_type(header: SequenceHeader) -> str:
    """PLUS's image type, told from the pixels where the header does not say."""
    named = header.fields.get("UltrasoundImageType")
    if named is not None:
        return named
    return "BRIGHTNESS" if header.pixels.dtype == np.uint8 else "RF_REAL"


def _joined(pixels: npt.NDArray[Any], axis: int) -> npt.NDArray[np.complex64]:
    turned = pixels if axis == 0 else pixels.T
    joined = np.empty(turned[0::2].shape, dtype=np.complex64)
    joined.real, joined.imag = turned[0::2], turned[1::2]
    return joined if axis == 0 else joined.T


def _parted(samples: npt.NDArray[Any], axis: int) -> npt.NDArray[np.float32]:
    turned = samples if axis == 0 else samples.T
    parted = np.empty((2 * turned.shape[0], turned.shape[1]), dtype=np.float32)
    parted[0::2], parted[1::2] = turned.real, turned.imag
    return parted if axis == 0 else parted.T
