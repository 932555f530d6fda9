"""Arrays, pictures and video: of machines that give only these. All but the pixels is given by settings.

Arrays are ``.npy`` files of shape (n, row, column): grey levels as uint8, or echoes (int16, float32,
complex64) whose samples run down the rows. A folder of PNG or JPEG is a sweep in the order of their names,
numbers in them counted. Colours become grey by luminance.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.images import ImageFrames
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Value

FORMAT = "arrays, pictures or video"

_ARRAY = b"\x93NUMPY"
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_STACKS = (".gif", ".tif", ".tiff")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".wmv", ".m4v", ".mpg", *_STACKS)
_NOTES = (".toml", ".txt", ".md", ".json", ".csv", ".db", ".ini")
"""Of files that may lie among pictures."""


class PictureFolder:
    """Pictures of a folder, in the order of their names."""

    any_thread = True

    def __init__(self, folder: Path) -> None:
        self._paths = _pictures(folder)
        first = self[0]
        self.shape, self.dtype = (len(self._paths), *first.shape), first.dtype

    def __getitem__(self, index: int) -> AnyArray:
        from PIL import Image

        with reading(self._paths[index], Exception), Image.open(self._paths[index]) as picture:
            grey = picture.mode in ("L", "I;16", "I")
            image = np.asarray(picture if grey else picture.convert("RGB"))
        if index and image.shape != self.shape[1:]:
            raise InvalidInputError(
                f"{self._paths[index]}: expected pictures of one size, got {image.shape}, and "
                f"{self.shape[1:]} before"
            )
        return image


class Video:
    """Frames of a video, or of a file of several pictures, by imageio; those in order are read fastest."""

    def __init__(self, path: Path) -> None:
        iio = extra_module("imageio.v3", "video", "a video")
        self._path, is_stack = path, path.suffix.lower() in _STACKS
        plugin = "pillow" if is_stack else None
        with reading(path, Exception):  # of whichever plugin imageio takes
            count = sum(1 for _ in iio.imiter(path, plugin=plugin))
            metadata = iio.immeta(path, plugin=plugin, exclude_applied=False)
            frame_ms = metadata.get("duration") if is_stack else None
            self.rate_hz = 1e3 / frame_ms if frame_ms else metadata.get("fps")
            self._file = iio.imopen(path, "r", plugin=plugin)
        first = self[0]
        self.shape, self.dtype = (count, *first.shape), first.dtype

    def __getitem__(self, index: int) -> AnyArray:
        with reading(f"{self._path}: frame {index}", Exception):
            return np.asarray(self._file.read(index=index))


def _pictures(folder: Path) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES]
    return sorted(paths, key=lambda path: [(len(word), word) for word in re.findall(r"\d+|\D+", path.name)])


def _claims(path: Path, start: bytes) -> bool:
    if path.is_dir():
        suffixes = {file.suffix.lower() for file in path.iterdir() if not file.name.startswith(".")} - {
            *_NOTES
        }
        return bool(suffixes) and suffixes <= {*_PICTURES}
    return start.startswith(_ARRAY) or path.suffix.lower() in _VIDEOS


def open_pictures(path: Path, settings: ImportSettings) -> Recording:
    """Read an array, a folder of pictures or a video."""
    images: Any
    if path.is_dir():
        images = PictureFolder(path)
    elif path.suffix.lower() in _VIDEOS:
        images = Video(path)
    else:
        with reading(path, Exception):
            images = np.load(path, mmap_mode="r", allow_pickle=False)
    rate = {"frame_rate_hz": Value(getattr(images, "rate_hz", None), "of the video")}
    colours = "pictures are in colour: taken as grey by luminance; what is drawn over the image stays"
    return Recording(
        path,
        settings,
        ImageFrames(images),
        rate,
        name=path.stem,
        assumptions=("parallel lines, as of a linear probe",),
        remarks=(colours,) if len(images.shape) == 4 else (),
    )


READER = Reader(
    FORMAT, _claims, open_pictures, companions=lambda path: _pictures(path) if path.is_dir() else ()
)
