"""Image sequences in MetaImage and NRRD files, as PLUS, ITK and ultrasound machines write them.

PLUS's names stay in this module, in `headers` and in `plus`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Sweep, Tracker
from speckle3d.io.carrier import sign_of_q
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.headers import SequenceHeader, is_metaimage, is_nrrd, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.frames import SequenceFrames
from speckle3d.io.plus.record import valid_images
from speckle3d.io.plus.source import Source
from speckle3d.io.readers import Reader, Row


def read_metaimage(path: PathLike, overrides: ImportSettings | None = None) -> Sweep:
    """Read an image sequence with the poses in its header; the frames stay on disk.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose image status is not OK are left out; their fields are kept with the others'.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the field that is wrong, or why the file is no sweep.
    MissingSettingsError
        Naming all that the file does not say.
    """
    source = Source.open(path, overrides or ImportSettings())
    chosen = source.require_images()
    values = source.settings.over(path, **source.wanted())
    frames = SequenceFrames(source.header, source.layout, source.record(), chosen)
    if _sign_of_q(frames, values) == -1:
        frames.record = source.record(conjugated=True)
    with naming(str(path)):
        grid, signal = source.geometry(values, frames.shape)
        return Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=source.frame_times(values)[chosen],
            orientation=source.orientation(),
            tracker=source.tracker(grid),
            name=printable(Path(path).name.split(".")[0]),
            probe=source.probe,
        )


def read_poses(path: PathLike, overrides: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    source = Source.open(path, overrides or ImportSettings())
    poses = source.poses
    if poses is None:
        raise InvalidInputError(
            f"{path}: expected tracked poses (fields like ProbeToTrackerTransform), got {lacking_poses(path)}"
        )
    return Tracker(poses.readings)


def lacking_poses(path: PathLike) -> str:
    """Say which transforms an image sequence holds, if not those of the usual names."""
    header = read_header(path)
    advice = ": name the sensor's with --transform" if header.transforms else ""
    return f"{', '.join(header.transforms) or 'none'}{advice}"


def _sign_of_q(frames: SequenceFrames, values: Mapping[str, Any]) -> int:
    """Sign of Q as it is stored: 1, -1, or 0 where the phase does not tell.

    It does not of I/Q that were shifted down, which turn either way. In lines that are stored from the far
    end on, depth runs backwards and so does the phase, unless the writer thought of it.
    """
    if values.get("demodulation_frequency_hz") != 0:
        return 0
    return sign_of_q(frames, values["centre_frequency_hz"], values["sampling_rate_hz"])


_SIGNS = {1: "told by the phase", -1: "turned, as told by the phase", 0: "as stored, not told by the phase"}


def _sign_rows(source: Source) -> list[Row]:
    """What is known of the sign of Q; nothing of other samples, or while a sweep cannot be read."""
    if not source.layout.is_complex:
        return []
    try:
        chosen = source.require_images()
        values = source.settings.over(source.path, **source.wanted())
        frames = SequenceFrames(source.header, source.layout, source.record(), chosen)
        return [("sign of Q", _SIGNS[_sign_of_q(frames, values)], "")]
    except InvalidInputError:
        return []  # Why there is no sweep is told beside these rows.


def describe_sequence(path: PathLike, settings: ImportSettings) -> list[Row]:
    """Tell what a header says, and what is taken from elsewhere or assumed."""
    source = Source.open(path, settings)
    header, layout = source.header, source.layout
    spacing = " x ".join(f"{s:g}" for s in header.spacing_mm or ()) or "unknown"
    rows = [
        ("container", header.file_format, ""),
        ("size", " x ".join(str(n) for n in header.size), ""),
        ("images", str(header.frame_count), ""),
        ("images not valid", str(np.count_nonzero(~valid_images(header.frames))), ""),
        ("spacing", spacing, "" if header.spacing_mm is None else "mm"),
        ("image type", _said(header, "UltrasoundImageType", layout.kind), ""),
        ("image orientation", _said(header, "UltrasoundImageOrientation", layout.orientation), ""),
        ("pixel type", header.pixels.dtype.name, ""),
        ("packing", header.pixels.packing, ""),
        ("transforms", ", ".join(header.transforms) or "none", ""),
        ("time stamps", "yes" if source.has_times else "no", ""),
    ]
    try:
        return [*rows, *source.sources(), *_sign_rows(source)]
    except InvalidInputError as error:
        return [*rows, ("poses", f"none: {error}", "")]


def _said(header: SequenceHeader, name: str, used: str) -> str:
    return used if name in header.fields else f"{used} (assumed)"


def _companions(path: Path) -> Sequence[Path]:
    pixels = read_header(path).pixels.path
    return () if pixels == path else (pixels,)


READER = Reader(
    "image",
    lambda _, start: is_metaimage(start) or is_nrrd(start),
    read_metaimage,
    describe_sequence,
    _companions,
    lambda path, settings: Source.open(path, settings).contradictions(),
)
