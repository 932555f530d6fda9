"""Frames of an image sequence, read one at a time."""

from __future__ import annotations

import operator
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray
from speckle3d.core.geometry import require_finite
from speckle3d.io.pixel_pieces import PixelPieces
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.record import SequenceRecord, write_record


class SequenceFrames:
    """Frames of a sequence whose image is valid, turned to vectors and samples.

    Parameters
    ----------
    pieces : PixelPieces
        An image each.
    size : tuple of int
        Pixels along x and y.
    layout : Layout
    record : SequenceRecord
        What the sequence says of its frames; ``/plus`` of a sweep file written from them.
    chosen : ndarray, shape (m,)
        Their numbers in the sequence.
    dtype : dtype
        Of the samples.
    """

    def __init__(
        self,
        pieces: PixelPieces,
        size: tuple[int, int],
        layout: Layout,
        record: SequenceRecord,
        chosen: npt.NDArray[np.intp],
        dtype: np.dtype[Any],
    ) -> None:
        self.pieces, self.size, self.layout, self.record = pieces, size, layout, record
        self.chosen, self.dtype = chosen, dtype

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        return (len(self), *self.layout.shape(self.size))

    def __len__(self) -> int:
        return int(self.chosen.size)

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        frame = self.layout.frame(self.pixels(int(self.chosen[i])))
        if frame.dtype.kind in "fc":
            require_finite(frame, f"{self.pieces.pixels.path}: frame {self.chosen[i]}")
        frame = frame.astype(self.dtype, copy=False)
        return np.conj(frame) if self.record.conjugated else frame

    def pixels(self, number: int) -> npt.NDArray[Any]:
        """Read an image of the sequence, whatever its status, shape (y, x)."""
        return self.pieces[number].reshape(self.size[::-1])

    def close(self) -> None:
        """Close the file if it is open; the next frame opens it again."""
        self.pieces.close()

    def write_more(self, file: h5py.File) -> None:
        """Write what the sequence says beside its pixels into a sweep file."""
        write_record(file, self.record)


def sample_type(
    pieces: PixelPieces, layout: Layout, chosen: BoolArray | npt.NDArray[np.intp]
) -> np.dtype[Any]:
    """Type of samples: that of the pixels, or int16 where it holds wider whole numbers, else float32.

    Whether it does is seen by reading all of them once.
    """
    dtype = pieces.pixels.dtype.newbyteorder("=")
    if layout.is_complex:
        return np.dtype(np.complex64)
    if not layout.is_rf or dtype == np.int16:
        return dtype
    limits = np.iinfo(np.int16)
    if dtype.kind in "iu":
        images = (pieces[int(i)] for i in chosen)
        if all(image.min() >= limits.min and image.max() <= limits.max for image in images):
            return np.dtype(np.int16)
    return np.dtype(np.float32)
