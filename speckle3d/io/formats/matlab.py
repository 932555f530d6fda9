"""MATLAB's ``.mat`` files, as saved by scripts of research scanners: a mapping says which array is what.

The mapping is the table ``arrays`` of the TOML file beside the recording, or of the options::

    frame_rate_hz = 25.0

    [arrays]
    rf = "RData"                       # or iq; or i and q; or bmode
    axes = "sample, vector, frame"     # of that array, as size(RData) has them; - for one of length 1
    vector_pitch_mm = "Trans.spacingMm"                      # a number of the file, as it is,
    sampling_rate_hz = "Receive(1).decimSampleRate * 1e6"    # or times (or /) another
    z_mm = "z * 1e3"                   # or positions: x_mm of vectors, z_mm of samples; time_s of frames

Nothing is guessed of an array: neither what it is nor which of its axes is which.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_increasing
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Frames, Sweep
from speckle3d.io.formats.matlab_file import USER_BLOCK, Listed, MatFile, open_matlab
from speckle3d.io.formats.recordings import Recording, step_of
from speckle3d.io.found import Found
from speckle3d.io.hdf5 import SIGNATURE
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.lazy import Layout, Slices
from speckle3d.io.readers import Reader, Row

FORMAT = "MATLAB"

_DATA = ("rf", "iq", "i", "q", "bmode")
_POSITIONS = ("x_mm", "z_mm", "time_s")
_NUMBERS = (
    "sampling_rate_hz", "vector_pitch_mm", "speed_of_sound_m_s", "centre_frequency_hz", "bandwidth_hz",
    "demodulation_frequency_hz", "first_sample_depth_mm", "column_pitch_mm", "row_spacing_mm",
    "dynamic_range_db", "frame_rate_hz",
)  # fmt: skip
_AXES = ("sample", "vector", "frame", "-")
_SCALED = re.compile(r"(?P<name>[^*/]+?)\s*(?:(?P<sign>[*/])\s*(?P<factor>[-+.\deE]+))?")
_MOST_SHOWN = 12
_MARK, _OLD_ORDERS = b"MATLAB", (b"IM", b"MI")


@dataclass(frozen=True)
class Placed:
    """Turns slices of arrays into frames.

    Attributes
    ----------
    shape : tuple of int
        Of a slice.
    vector, sample : int
        Axes of a slice; others have length 1.
    grey : bool
        Whether the numbers must be grey levels.
    """

    shape: tuple[int, ...]
    vector: int
    sample: int
    grey: bool

    def __call__(self, slices: Slices) -> npt.NDArray[Any]:
        """Make a frame of one array, or of I and Q."""
        parts = [self._turned(part) for part in slices]
        if self.grey:
            return _levels(parts[0])
        if len(parts) == 1 and not parts[0].dtype.names:
            return parts[0]
        real, imaginary = parts if len(parts) == 2 else (parts[0]["real"], parts[0]["imag"])
        made = np.empty(real.shape, np.complex64)
        made.real, made.imag = real, imaginary
        return made

    def _turned(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return Layout(self.shape, (self.vector, self.sample)).of(values)


def _levels(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    made = values.astype(np.float64)
    if not ((made >= 0) & (made <= 255) & (made == np.rint(made))).all():
        raise InvalidInputError("bmode: expected grey levels, whole numbers from 0 to 255, got others")
    return made.astype(np.uint8)


def read_matlab(path: Path, settings: ImportSettings | None = None) -> Sweep:
    """Read the arrays that a mapping names; of version 7.3 frame by frame, of earlier ones in memory.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Listing the arrays and what to write, without a mapping; or naming what contradicts it.
    MissingSettingsError
        Naming all numbers that neither the mapping nor the settings give.
    """
    settings = settings or ImportSettings()
    with open_matlab(path) as file:
        return _recording(file, settings).sweep(settings)


def _claims(_: Path, start: bytes) -> bool:
    is_old = start[126:128] in _OLD_ORDERS and start[124:126] in (b"\0\1", b"\1\0")
    is_new = start[USER_BLOCK : USER_BLOCK + len(SIGNATURE)] == SIGNATURE
    return start.startswith(_MARK) and (is_old or is_new)


def _describe(path: Path, settings: ImportSettings) -> list[Row]:
    with open_matlab(path) as file:
        rows: list[Row] = [(f"array {one.name}", _size(one.size), one.kind) for one in _largest(file)]
        if not settings.arrays:
            return rows
        try:
            return [*rows, *_recording(file, settings).rows(settings)]
        except InvalidInputError:
            return rows  # the sweep's own row says why there is none


def _largest(file: MatFile) -> list[Listed]:
    return sorted(file.arrays(), key=lambda one: -int(np.prod(one.size)))[:_MOST_SHOWN]


def _recording(file: MatFile, settings: ImportSettings) -> Recording:
    path, arrays = file.path, settings.arrays
    where = f"{path}: arrays"
    unknown = sorted(set(arrays) - {*_DATA, *_POSITIONS, *_NUMBERS, "axes"})
    if unknown:
        raise InvalidInputError(f"{where}: expected {', '.join(_DATA)}, axes, got {printable(unknown[0])}")
    data = [name for name in _DATA if name in arrays]
    if data not in (["rf"], ["iq"], ["i", "q"], ["bmode"]):
        raise InvalidInputError(_asking(file, data))
    names = [arrays[name] for name in data]
    size, kind = file.size(names[0])
    for name in names[1:]:
        if file.size(name)[0] != size:
            got = _size(file.size(name)[0])
            raise InvalidInputError(f"{where}: {name}: expected size {_size(size)} as {names[0]}, got {got}")
    if "axes" not in arrays:
        raise InvalidInputError(
            f"{where}: {printable(names[0])} is {_size(size)}: say which of its axes is which by axes = "
            f'"sample, vector, frame" in {path.name}.toml'
        )
    with naming(where):
        places, size = _places(arrays["axes"], size)
        _require_kind(data, kind)
    frames = _frames(file, data, names, size, places, kind)
    found, spacing, times = _numbers(file, arrays, frames.shape)
    notes: list[Row] = [("read", f"{name}: {arrays[name]} {_size(size)}", str(kind)) for name in data]
    notes.append(("axes", arrays["axes"], ""))
    if not file.reversed:
        notes.append(("frames", "held in memory: MATLAB 7.3 files are read one by one", ""))
    return Recording(path, frames, found, sample_spacing_mm=spacing, time_s=times, notes=tuple(notes))


def _asking(file: MatFile, data: list[str]) -> str:
    listed = ", ".join(map(str, _largest(file))) or "none"
    got = f"{' and '.join(data)} of " if data else ""
    return (
        f"{file.path}: expected to be told which array is what: write rf (or iq, or i and q, or bmode) = "
        f'"NAME" and axes = "sample, vector, frame" below [arrays] in {file.path.name}.toml beside it; there '
        f"are {got}{listed}"
    )


def _places(text: str, size: tuple[int, ...]) -> tuple[dict[str, int], tuple[int, ...]]:
    """Axis of each name, and the size with an axis for each: MATLAB leaves out last ones of length 1."""
    axes = [axis.strip() for axis in text.split(",")]
    named = [axis for axis in axes if axis != "-"]
    if any(axis not in _AXES for axis in axes) or len(set(named)) != len(named):
        raise InvalidInputError(
            f"axes: expected sample, vector, frame and -, once each, got {printable(text)}"
        )
    if "sample" not in axes or "vector" not in axes:
        raise InvalidInputError(f"axes: expected sample and vector among them, got {printable(text)}")
    full = size + (1,) * (len(axes) - len(size))
    if len(axes) < len(full):
        raise InvalidInputError(f"axes: expected {len(full)} of {_size(size)}, got {printable(text)}")
    for axis, length in zip(axes, full, strict=True):
        if axis == "-" and length != 1:
            raise InvalidInputError(
                f"axes: expected - for an axis of length 1, got {length} of {_size(size)}"
            )
    return {axis: i for i, axis in enumerate(axes) if axis != "-"}, full


def _require_kind(data: list[str], kind: np.dtype[Any]) -> None:
    is_complex = kind.kind == "c" or bool(kind.names)
    if is_complex != (data == ["iq"]):
        got = "complex" if is_complex else "real"
        raise InvalidInputError(
            f"{data[0]}: expected {'complex' if data == ['iq'] else 'real'}, got {got} ones"
        )


def _frames(
    file: MatFile, data: list[str], names: list[str], size: tuple[int, ...], places: dict[str, int], kind: Any
) -> Frames:
    axis = places.get("frame")
    rest = [i for i in range(len(size)) if i != axis]
    stored = rest[::-1] if file.reversed else rest
    turn = Placed(
        tuple(size[i] for i in stored),
        stored.index(places["vector"]),
        stored.index(places["sample"]),
        data == ["bmode"],
    )
    shape = (1 if axis is None else size[axis], size[places["vector"]], size[places["sample"]])
    if 0 in shape:
        raise InvalidInputError(f"{file.path}: {names[0]}: expected echoes, got size {_size(size)}")
    dtype: Any = np.uint8 if data == ["bmode"] else np.float32
    if data in (["iq"], ["i", "q"]):
        dtype = np.complex64
    elif data == ["rf"] and kind in (np.int8, np.uint8, np.int16):
        dtype = np.int16
    if axis is not None and axis >= len(file.size(names[0])[0]):
        axis = None
    return file.frames(names, axis, turn, shape, dtype)


def _numbers(
    file: MatFile, arrays: dict[str, str], shape: tuple[int, int, int]
) -> tuple[dict[str, Found], float | None, FloatArray | None]:
    """Numbers that arrays give, the distance between samples if z_mm gives it, and times."""
    found = {}
    for name in _NUMBERS:
        if name not in arrays:
            continue
        values = _scaled(file, name, arrays[name])
        wanted = 2 if name == "bandwidth_hz" else 1
        if values.size != wanted and not (wanted == 1 and values.size and (values == values[0]).all()):
            where = f"{file.path}: {name} = {printable(arrays[name])}"
            raise InvalidInputError(f"{where}: expected {wanted} number(s), got {values.size}")
        value = (float(values[0]), float(values[1])) if wanted == 2 else float(values[0])
        found[name] = Found(value, f"in {arrays[name]}")
    placed = {name: _scaled(file, name, arrays[name]) for name in _POSITIONS if name in arrays}
    lengths = dict(
        zip(_POSITIONS, (("vectors", shape[1]), ("samples", shape[2]), ("frames", shape[0])), strict=True)
    )
    for name, values in placed.items():
        spoken, length = lengths[name]
        if values.size != length:
            raise InvalidInputError(
                f"{file.path}: {name} = {printable(arrays[name])}: expected {length} numbers for {length} "
                f"{spoken}, got {values.size}: are axes = {printable(arrays['axes'])} in this order?"
            )
    spacing = None
    if "x_mm" in placed:
        pitch = Found(step_of(placed["x_mm"], f"{file.path}: x_mm"), f"in {arrays['x_mm']}")
        found |= {"vector_pitch_mm": pitch, "column_pitch_mm": pitch}
    if "z_mm" in placed:
        spacing = step_of(placed["z_mm"], f"{file.path}: z_mm")
        found["row_spacing_mm"] = Found(spacing, f"in {arrays['z_mm']}")
        found["first_sample_depth_mm"] = Found(float(placed["z_mm"][0]), f"in {arrays['z_mm']}")
    times = placed.get("time_s")
    return found, spacing, None if times is None else require_increasing(times, f"{file.path}: time_s")


def _scaled(file: MatFile, name: str, text: str) -> FloatArray:
    """Numbers of an array, in one row, times the factor behind its name."""
    parts = _SCALED.fullmatch(text.strip())
    try:
        factor = float(parts["factor"] or 1.0) if parts else np.nan
    except ValueError:
        factor = np.nan
    if parts is None or not np.isfinite(factor) or factor == 0:
        raise InvalidInputError(
            f"{file.path}: {name}: expected as NAME, NAME * 1e6 or NAME / 2, got {printable(text)}"
        )
    values = file.values(parts["name"])
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise InvalidInputError(
            f"{file.path}: {name} = {printable(text)}: expected finite numbers, got others"
        )
    flat = values.astype(np.float64).ravel("F")
    return flat * factor if parts["sign"] == "*" else flat / factor


def _size(size: tuple[int, ...]) -> str:
    return " x ".join(map(str, size))


def _contradictions(path: Path, settings: ImportSettings) -> list[str]:
    if not {*_POSITIONS, *_NUMBERS} & settings.arrays.keys():
        return []  # and earlier versions need not be read into memory again
    with open_matlab(path) as file:
        return _recording(file, settings).contradictions(settings)


READER = Reader(FORMAT, _claims, read_matlab, _describe, notes=_contradictions)
