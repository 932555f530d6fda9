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
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.images import Images
from speckle3d.core.printable import printable
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.io.hdf5 import one_line, reading
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.readers import Reader

FORMAT = "arrays, pictures or video"

_ARRAY = b"\x93NUMPY"
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".wmv", ".m4v", ".mpg", ".gif")


class PictureFolder:
    """Pictures of a folder, in the order of their names."""

    any_thread = True

    def __init__(self, folder: Path) -> None:
        self._paths = _pictures(folder)
        first = self[0]
        self.shape, self.dtype = (len(self._paths), *first.shape), first.dtype

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        from PIL import Image

        with reading(self._paths[index]), Image.open(self._paths[index]) as picture:
            grey = picture.mode in ("L", "I;16", "I")
            return np.asarray(picture if grey else picture.convert("RGB"))


class Video:
    """Frames of a video, by imageio; those in order are read fastest."""

    def __init__(self, path: Path) -> None:
        self._path, self._iio = path, extra_module("imageio.v3", "video", "a video")
        self._next, self._frames = 0, iter(list[npt.NDArray[Any]]())
        try:
            first, self.rate_hz = self[0], self._iio.immeta(path, exclude_applied=False).get("fps")
            count = sum(1 for _ in self._iio.imiter(path))
        # A plugin that is missing or a damaged file shows in whatever imageio's plugins raise.
        except Exception as error:
            raise FileError(f"{path}: cannot be read as video: {one_line(error)}") from error
        self.shape, self.dtype = (count, *first.shape), first.dtype

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        if index < self._next or not self._next:
            self._next, self._frames = 0, iter(self._iio.imiter(self._path))
        for frame in self._frames:
            self._next += 1
            if self._next > index:
                return np.asarray(frame)
        raise FileError(f"{self._path}: frame {index}: expected it in the video, got its end")


def _pictures(folder: Path) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES]
    return sorted(paths, key=lambda path: [(len(word), word) for word in re.findall(r"\d+|\D+", path.name)])


def _claims(path: Path, start: bytes) -> bool:
    if path.is_dir():
        own = [each for each in path.iterdir() if each.suffix != ".toml" and not each.name.startswith(".")]
        return bool(own) and all(each.suffix.lower() in _PICTURES for each in own)
    return start.startswith(_ARRAY) or path.suffix.lower() in _VIDEOS


def _images(path: Path) -> Images:
    if path.is_dir():
        return PictureFolder(path)
    if path.suffix.lower() in _VIDEOS:
        return Video(path)
    with reading(path):
        images: Images = np.load(path, mmap_mode="r", allow_pickle=False)
    return images


def _read(path: Path, settings: ImportSettings) -> Sweep:
    images = _images(path)
    rate = {"frame_rate_hz": getattr(images, "rate_hz", None)}
    signal = None
    if images.dtype == np.uint8:
        pixels = {"column_pitch_mm": None, "row_spacing_mm": None, "dynamic_range_db": None}
        values = settings.over(path, **pixels, **rate)
        pitch = values["column_pitch_mm"], values["row_spacing_mm"]
    else:
        names = ("vector_pitch_mm", "sampling_rate_hz", "centre_frequency_hz", "bandwidth_hz")
        carrier = {"demodulation_frequency_hz": None} if np.dtype(images.dtype).kind == "c" else {}
        speed = {"speed_of_sound_m_s": SPEED_OF_SOUND_M_S}
        values = settings.over(path, **dict.fromkeys(names), **speed, **carrier, **rate)
        pitch = values["vector_pitch_mm"], 1.0  # the rows' is that of the samples
        signal = RFSettings(**{name: values[name] for name in (*names[1:], *speed, *carrier)})
    if len(images.shape) not in (3, 4):
        raise InvalidInputError(f"{path}: expected images of shape (n, row, column), got {images.shape}")
    return Sweep.from_arrays(
        images,
        pitch_mm=pitch,
        frame_rate_hz=values["frame_rate_hz"],
        dynamic_range_db=values.get("dynamic_range_db"),
        signal=signal,
        first_row_depth_mm=settings.first_sample_depth_mm or 0.0,
        name=printable(path.stem),
        probe=settings.probe or "",
    )


def _notes(path: Path, settings: ImportSettings) -> list[str]:
    images = _images(path)
    notes = ["lines are taken for parallel, as of a linear probe"]
    if len(images.shape) == 4:
        notes.append("pictures are in colour: taken as grey by luminance; what is drawn over the image stays")
    if images.dtype != np.uint8 and settings.speed_of_sound_m_s is None:
        notes.append(f"speed of sound {SPEED_OF_SOUND_M_S:g} m/s, assumed")
    return [f"{path}: {note}" for note in notes]


READER = Reader(
    FORMAT, _claims, _read, companions=lambda path: _pictures(path) if path.is_dir() else (), notes=_notes
)
