"""Images and transforms as they are received, made into what a sweep holds."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import Sweep
from speckle3d.io.igtl.messages import ImageReceived, packed_transform
from speckle3d.io.images.headers import RAS_FROM_LPS
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError, option_of
from speckle3d.io.plus.transforms import pixel_matrix
from speckle3d.io.recordings import Recording, Value

POSE = "ImageToReference"
"""Device of poses: pixels of the received images to the first image's mm, as PLUS names it."""
_ECHOES, _GREY_LEVELS = ("int16", "float32"), "uint8"


@dataclass(frozen=True)
class ImageLayout:
    """Layout of a device's IMAGE messages, and their conversion to frames.

    Attributes
    ----------
    device : str
    example : Sweep
        Of one black frame: grid, signal and type of those that come.
    samples_along_columns : bool
        Whether the pixels of a row of the message are one vector's samples, as PLUS sends RF.
    """

    device: str
    example: Sweep
    samples_along_columns: bool

    @classmethod
    def of(cls, image: ImageReceived, settings: ImportSettings, name: str) -> Self:
        """Layout of the images that are like the first one.

        Parameters
        ----------
        image : ImageReceived
        settings : ImportSettings
            What messages do not say. Pixels of 8 bits are grey levels of B-mode, whose sizes are the
            message's unless given, others are samples of RF.
        name : str
            Of the sweep, for messages.

        Raises
        ------
        MissingSettingsError
            Naming every setting that is needed and not given.
        InvalidInputError
            If the pixels are of another shape or type.
        """
        where = f"IMAGE {image.device}"
        pixels = _plane(image, where)
        of_rf = pixels.dtype.name in _ECHOES
        if not of_rf and pixels.dtype.name != _GREY_LEVELS:
            kinds = f"{_GREY_LEVELS} for B-mode or {' or '.join(_ECHOES)} for RF"
            raise InvalidInputError(f"{where}: expected {kinds}, got {pixels.dtype}")
        try:
            example = _example(pixels, image, settings, where)
        except MissingSettingsError as error:
            options = ", ".join(map(option_of, error.settings))
            raise MissingSettingsError(
                f"{where}: its messages do not say what {'RF' if of_rf else 'B-mode'} needs, so give "
                f"{options} (`speckle3d live --help` tells what they are)"
            ) from None
        return cls(image.device, replace(example, name=name, probe=settings.probe or ""), of_rf)

    def frame(self, image: ImageReceived) -> AnyArray:
        """Frame of an image, shape (vector, sample).

        Raises
        ------
        InvalidInputError
            If it is of another shape or type than the first.
        """
        where = f"IMAGE {image.device}"
        pixels = _plane(image, where)
        frame = pixels.T if self.samples_along_columns else pixels
        frames = self.example.frames
        if frame.shape != frames.shape[1:] or frame.dtype != frames.dtype:
            raise InvalidInputError(
                f"{where}: expected {frames.shape[1:]} of {frames.dtype} as the first, got {frame.shape} of "
                f"{frame.dtype}"
            )
        return np.ascontiguousarray(frame)

    def pose_message(self, world_from_image: RigidTransform, time_s: float) -> bytes:
        """TRANSFORM from a received image's pixels (column, row, slice) to the world, at the image's time."""
        image_from_pixel = message_matrix(self.example.grid, not self.samples_along_columns)
        return packed_transform(POSE, time_s, RAS_FROM_LPS @ world_from_image.as_matrix() @ image_from_pixel)


def message_matrix(grid: ImageGrid, upright: bool) -> FloatArray:
    """From (column, row, slice, 1) of a message's pixel to the image's mm, shape (4, 4)."""
    matrix = pixel_matrix(grid)
    # Where columns are samples, slices turn round so that the axes stay right-handed.
    return matrix if upright else matrix[:, [1, 0, 2, 3]] @ np.diag([1.0, 1.0, -1.0, 1.0])


def _plane(image: ImageReceived, where: str) -> AnyArray:
    """Pixels of a single grey image, shape (column, row)."""
    pixels = image.pixels
    if pixels.ndim != 2:
        raise InvalidInputError(
            f"{where}: expected one image of grey levels or echoes, got shape {pixels.shape}"
        )
    return pixels


def _example(pixels: AnyArray, image: ImageReceived, settings: ImportSettings, where: str) -> Sweep:
    """Sweep of one black frame; of RF the speed of sound must be given: no message has it."""
    if pixels.dtype != _GREY_LEVELS:
        values, black = {"speed_of_sound_m_s": Value()}, np.zeros_like(pixels.T)
    else:
        column_mm, row_mm = image.spacing_mm[:2].tolist()
        has_size = column_mm > 0 < row_mm and (column_mm, row_mm) != (1.0, 1.0)
        sizes = {"column_pitch_mm": Value(column_mm), "row_spacing_mm": Value(row_mm)}
        values, black = sizes if has_size else {}, np.zeros_like(pixels)
    return Recording(Path(where), settings, black[None], values).sweep
