"""Images as NumPy, pictures and video have them, (row, column), read as the frames of a sweep."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError

_LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Of red, green and blue: ITU-R BT.601."""

_KINDS = ("uint8", "int16", "float32", "complex64")
"""Grey levels, echoes, and complex ones."""


class ImageFrames:
    """Frames (column, row) of images; colours become grey by luminance.

    Parameters
    ----------
    images : array, or what has its shape and dtype and gives one when indexed
        Shape (n, row, column), with an axis of 3 or 4 colours more or not.

    Raises
    ------
    InvalidInputError
        If the images are of another shape or type.
    """

    def __init__(self, images: Any) -> None:
        shape: tuple[int, ...] = images.shape
        kind: np.dtype[Any] = np.dtype(images.dtype)
        in_colour = shape[3:] in ((3,), (4,)) and kind == np.uint8
        if len(shape) != 3 + in_colour or 0 in shape or kind.name not in _KINDS:
            raise InvalidInputError(
                f"frames: expected images of shape (n, row, column) of {', '.join(_KINDS)}, or uint8 "
                f"(n, row, column, 3), got {shape} of {kind}"
            )
        self.any_thread = any_thread(images)
        self._images, self.dtype = images, kind.newbyteorder("=")
        self.shape = (shape[0], shape[2], shape[1])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int | slice) -> npt.NDArray[Any]:
        if isinstance(index, slice):
            return np.stack([self[i] for i in range(*index.indices(len(self)))])
        image = np.asarray(self._images[range(len(self))[index]])
        if image.shape[:2] != self.shape[:0:-1]:
            raise InvalidInputError(
                f"frame {index}: expected {self.shape[2]} rows of {self.shape[1]} columns, got {image.shape}"
            )
        if image.ndim == 3:
            image = np.rint(image[..., :3] @ _LUMINANCE).astype(np.uint8)
        return np.ascontiguousarray(image.T, self.dtype)


def any_thread(images: object) -> bool:
    """Whether images may be read by several threads at once: arrays, and what says ``any_thread = True``."""
    return isinstance(images, np.ndarray) or getattr(images, "any_thread", False)
