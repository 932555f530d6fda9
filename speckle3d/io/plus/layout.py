"""Layout of a PLUS image's pixels, and its conversion to vectors and samples and back.

PLUS's orientations name where the first and the second axis of an image lead: to the marked (M) or unmarked
(U) side of the probe, far from (F) or near to (N) it [1]_.

References
----------
.. [1] PLUS user manual, "Ultrasound image orientation".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.io.images.headers import SequenceHeader

RF_TYPES = ("RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE")
_SIDES = ({"M", "F"}, {"M", "N"}, {"U", "F"}, {"U", "N"})


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

    @classmethod
    def of(cls, header: SequenceHeader, machine: str | None = None) -> Layout:
        """Tell an image's layout; where the header does not say, by pixels and as PLUS does by default.

        PLUS stores B-mode as MF and RF as FM. A machine's orientation, from a device set, replaces that for
        the kind of image whose lines run so.
        """
        by_pixels = "BRIGHTNESS" if header.dtype == np.uint8 else "RF_REAL"
        kind = header.fields.get("UltrasoundImageType", by_pixels)
        usual = "FM" if kind in RF_TYPES else "MF"
        if machine is not None and (machine[:1].upper() in "FN") == (usual == "FM"):
            usual = machine
        return cls(kind, header.fields.get("UltrasoundImageOrientation", usual).upper())

    @property
    def is_rf(self) -> bool:
        """Whether samples are radio-frequency ones, real or I and Q."""
        return self.kind in RF_TYPES

    @property
    def is_complex(self) -> bool:
        """Whether samples are I and Q."""
        return self.kind in RF_TYPES[1:]

    @property
    def has_lines_in_rows(self) -> bool:
        """Whether depth grows, or shrinks, along the first axis."""
        return self.orientation.startswith(("F", "N"))

    def fault(self, header: SequenceHeader) -> str:
        """Why images are no ultrasound lines; empty where they are."""
        content, dtype = "colour" if header.channels > 1 else self.kind, header.dtype.newbyteorder("=")
        if content not in (*RF_TYPES, "BRIGHTNESS"):
            return f"expected grey B-mode or RF images, got {content}: export them as grey"
        if self.kind == "BRIGHTNESS" and dtype != np.uint8:
            return f"expected B-mode of type uint8, got {dtype}"
        if {*self.orientation[:2]} not in _SIDES or self.orientation[2:] not in ("", "A", "D"):
            return f"UltrasoundImageOrientation: expected as MF, FM or MFA, got {self.orientation}"
        return ""

    def frame(self, pixels: AnyArray) -> AnyArray:
        """Turn pixels, shape (y, x), into samples, shape (vector, sample): marked and far sides last."""
        lines = pixels if self.has_lines_in_rows else pixels.T
        if self.is_complex:
            axis = int(self.kind == "RF_IQ_LINE")  # of (line, number), along which I and Q alternate
            pairs = np.moveaxis(lines, axis, 0)
            lines = np.moveaxis(pairs[0::2] + np.complex64(1j) * pairs[1::2], 0, axis)
        lines = lines[:, ::-1] if "N" in self.orientation[:2] else lines
        return lines[::-1] if "U" in self.orientation[:2] else lines

    def shape(self, size: tuple[int, ...]) -> tuple[int, int]:
        """Vectors and samples of an image of a size (x, y)."""
        vectors, samples = self.frame(np.broadcast_to(np.int8(0), size[1::-1])).shape
        return vectors, samples
