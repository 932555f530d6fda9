"""One image or all of a recording: what detectors are given, and frames read one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.sweep import Frames

Found = TypeVar("Found")


def require_image(image: npt.NDArray[Any]) -> None:
    """Raise `InvalidInputError` unless an image is real, of shape (column, row)."""
    if image.ndim != 2 or not np.isrealobj(image):
        raise InvalidInputError(f"image: expected real values (column, row), got {image.dtype} {image.shape}")


def in_every_frame(
    frames: Frames,
    find: Callable[[npt.NDArray[Any]], Found],
    progress: Callable[[int, int], None] | None = None,
) -> list[Found]:
    """Apply a detector to every frame, read one at a time; an error names the frame.

    Parameters
    ----------
    frames : Frames, shape (n, column, row)
    find : callable
    progress : callable, optional
        Called with the number of frames done and their total.
    """
    found, count = [], frames.shape[0]
    for index in range(count):
        with naming(f"frame {index}"):
            found.append(find(np.asarray(frames[index])))
        if progress:
            progress(index + 1, count)
    return found
