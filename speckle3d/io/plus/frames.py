"""Frames of an image sequence, read one at a time."""

from __future__ import annotations

from functools import partial
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.io.headers import SequenceHeader
from speckle3d.io.lazy import LazyFrames, OpenFrames, Unpack
from speckle3d.io.pixel_pieces import PixelPieces
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.record import SequenceRecord, write_record


class SequenceFrames(LazyFrames):
    """Frames of a sequence whose image is valid, turned to vectors and samples.

    Parameters
    ----------
    header : SequenceHeader
    layout : Layout
    record : SequenceRecord
        What the sequence says of its frames; ``/plus`` of a sweep file written from them.
    chosen : ndarray, shape (m,)
        Their numbers in the sequence.
    """

    def __init__(
        self, header: SequenceHeader, layout: Layout, record: SequenceRecord, chosen: npt.NDArray[np.intp]
    ) -> None:
        self.pixels, self.size, self.layout = header.pixels, header.size[:2], layout
        self.record, self.chosen = record, chosen.tolist()
        shape = len(self.chosen), *layout.shape(self.size)
        super().__init__(header.path, shape, _sample_type(header, layout, self.chosen))

    def _opened(self) -> OpenFrames:
        return _OpenSequence(self)

    @property
    def stored_dtype(self) -> np.dtype[Any]:
        """What a sweep file needs to hold them: pairs of int16 for I and Q of 16 bits as they were read."""
        # A turned Q may be one more than int16 holds.
        narrow = self.dtype.kind == "c" and self.pixels.dtype.newbyteorder("=") == np.int16
        return np.dtype(np.int16) if narrow and not self.record.conjugated else self.dtype

    def write_more(self, file: h5py.File) -> None:
        """Write what the sequence says beside its pixels into a sweep file."""
        write_record(file, self.record)


class _OpenSequence:
    def __init__(self, frames: SequenceFrames) -> None:
        self._frames = frames
        self._pieces = PixelPieces(frames.pixels, frames.size[0] * frames.size[1])

    def read(self, i: int) -> Unpack:
        return partial(self._frame, self._pieces[self._frames.chosen[i]])

    def _frame(self, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        frames = self._frames
        image = pixels.reshape(frames.size[::-1])
        with np.errstate(over="ignore"):  # of what float32 does not hold, found as not finite
            frame = frames.layout.frame(image).astype(frames.dtype, copy=False)
        return np.conj(frame) if frames.record.conjugated else frame

    def close(self) -> None:
        self._pieces.close()


def _sample_type(header: SequenceHeader, layout: Layout, chosen: list[int]) -> np.dtype[Any]:
    """Type of samples: that of the pixels, or int16 where it holds wider whole numbers, else float32.

    Whether it does is seen by reading all of them once.
    """
    dtype = header.pixels.dtype.newbyteorder("=")
    if layout.is_complex:
        return np.dtype(np.complex64)
    if not layout.is_rf or dtype == np.int16:
        return dtype
    if dtype.kind not in "iu":
        return np.dtype(np.float32)
    limits = np.iinfo(np.int16)
    pieces = PixelPieces(header.pixels, header.size[0] * header.size[1])
    try:
        images = (pieces[i] for i in chosen)
        fits = all(image.min() >= limits.min and image.max() <= limits.max for image in images)
    finally:
        pieces.close()
    return np.dtype(np.int16 if fits else np.float32)
