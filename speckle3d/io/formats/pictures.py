"""Arrays, pictures and video: of machines that give only these. All but the pixels is given by settings.

Arrays are ``.npy`` files, or the largest of ``.npz``, of shape (n, row, column): grey levels as uint8, or
echoes (int16, float32, complex64) whose samples run down the rows. A folder of PNG or JPEG is a sweep in the
order of their names, numbers in them counted. Colours become grey by luminance.
"""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.core.extras import extra_module
from speckle3d.core.images import IN_COLOUR, ImageFrames
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Value

FORMAT = "arrays, pictures or video"

_ARRAY = b"\x93NUMPY"
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_STACKS = (".gif", ".tif", ".tiff")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".wmv", ".m4v", ".mpg", *_STACKS)


def _open_pictures(paths: list[Path]) -> ReadFrame:
    """Read pictures, each of its own file."""
    from PIL import Image

    def picture(i: int) -> AnyArray:
        with reading(paths[i], Exception), Image.open(paths[i]) as image:
            return np.asarray(image if image.mode in ("L", "I;16", "I") else image.convert("RGB"))

    return picture


def _open_video(path: Path, plugin: str | None) -> ReadFrame:
    """Read frames of a video, or of a file of several pictures; those in order are read fastest."""
    file = extra_module("imageio.v3", "video", "a video").imopen(path, "r", plugin=plugin)

    def picture(i: int) -> AnyArray:
        with reading(f"{path}: frame {i}", Exception):
            return np.asarray(file.read(index=i))

    return picture


def _pictures(folder: Path) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES]
    return sorted(paths, key=lambda path: [(len(word), word) for word in re.findall(r"\d+|\D+", path.name)])


def _claims(path: Path, start: bytes) -> bool:
    if path.is_dir():
        return bool(_pictures(path))
    return start.startswith(_ARRAY) or path.suffix.lower() in (".npz", *_VIDEOS)


def open_pictures(path: Path, settings: ImportSettings) -> Recording:
    """Read an array, a folder of pictures or a video."""
    images: Any = None
    rate_hz = None
    with reading(path, Exception):  # of whichever plugin imageio takes
        if path.is_dir():
            source: Callable[[], ReadFrame] = partial(_open_pictures, _pictures(path))
            count = len(_pictures(path))
        elif path.suffix.lower() in _VIDEOS:
            iio = extra_module("imageio.v3", "video", "a video")
            plugin = "pillow" if path.suffix.lower() in _STACKS else None
            source = partial(_open_video, path, plugin)
            count = sum(1 for _ in iio.imiter(path, plugin=plugin))
            metadata = iio.immeta(path, plugin=plugin, exclude_applied=False)
            frame_ms = metadata.get("duration") if plugin else None
            rate_hz = 1e3 / frame_ms if frame_ms else metadata.get("fps")
        else:
            images = np.load(path, mmap_mode="r", allow_pickle=False)
            if not isinstance(images, np.ndarray):  # several arrays (.npz), of which images are the largest
                images = max(images.values(), key=np.size)
    if images is None:
        first = source()(0)
        images = FileFrames(path, source, (count, *first.shape), first.dtype)
    return Recording(
        path,
        settings,
        ImageFrames(images),
        {"frame_rate_hz": Value(rate_hz, "of the video")},
        name=path.stem,
        assumptions=("parallel lines, as of a linear probe",),
        remarks=(IN_COLOUR,) if len(images.shape) == 4 else (),
    )


READER = Reader(
    FORMAT, _claims, open_pictures, companions=lambda path: _pictures(path) if path.is_dir() else ()
)
