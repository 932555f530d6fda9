"""MATLAB's ``.mat`` files, as saved by scripts of research scanners: a mapping says which array is what.

The mapping is the table ``arrays`` of the TOML file beside the recording, or of the options::

    frame_rate_hz = 25.0

    [arrays]
    rf = "RData"                       # or iq; or i and q; or bmode
    axes = "sample, vector, frame"     # of that array, as size(RData) has them; - for one of length 1
    vector_pitch_mm = "Trans.spacingMm"                      # a number of the file, as it is,
    sampling_rate_hz = "Receive(1).decimSampleRate * 1e6"    # or times (or /) another
    z_mm = "z * 1e3"                   # or positions: x_mm of vectors, z_mm of samples; time_s of frames

Nothing is guessed of an array: neither what it is nor which of its axes is which. Versions 5 to 7 are read by
SciPy, whole; version 7.3, which is HDF5 behind 512 bytes of text, frame by frame. An array is named as in
MATLAB, ``RcvData{1}`` or ``Trans.spacing`` or ``Receive(3).endSample``, counted from 1.
"""

from __future__ import annotations

import re
import warnings
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.geometry import require_finite
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Frames
from speckle3d.io.formats.hdf5_values import Grid, HDF5File, member
from speckle3d.io.frames import FileFrames
from speckle3d.io.hdf5 import SIGNATURE, one_line, open_hdf5, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.pose_paths import left_out, rising
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, step_of

FORMAT = "MATLAB"
USER_BLOCK = 512
"""Bytes of text before the HDF5 part of version 7.3."""

_DATA = ("rf", "iq", "i", "q", "bmode")
_POSITIONS = ("x_mm", "z_mm", "time_s")
_NUMBERS = (
    "sampling_rate_hz", "vector_pitch_mm", "speed_of_sound_m_s", "centre_frequency_hz", "bandwidth_hz",
    "demodulation_frequency_hz", "first_sample_depth_mm", "column_pitch_mm", "row_spacing_mm",
    "dynamic_range_db", "frame_rate_hz",
)  # fmt: skip
_SCALED = re.compile(r"(?P<name>[^*/]+?)\s*(?:(?P<sign>[*/])\s*(?P<factor>[-+.\deE]+))?")
_MOST_SHOWN, _MOST_LEVELS, _MOST_ELEMENTS = 12, 4, 8
"""Arrays that are listed; structs within each other, and elements of each, in which they are looked for."""
_MARK, _OLD_ORDERS = b"MATLAB", (b"IM", b"MI")


def _claims(_: Path, start: bytes) -> bool:
    is_old = start[126:128] in _OLD_ORDERS and start[124:126] in (b"\0\1", b"\1\0")
    is_new = start[USER_BLOCK : USER_BLOCK + len(SIGNATURE)] == SIGNATURE
    return start.startswith(_MARK) and (is_old or is_new)


def open_matlab(path: Path, settings: ImportSettings) -> Recording:
    """Read the arrays that a mapping names; without one, list the arrays and what to write."""
    with open(path, "rb") as stream:
        stream.seek(USER_BLOCK)
        is_new = stream.read(len(SIGNATURE)) == SIGNATURE
    file = _HDF5(path) if is_new else _Whole(path)
    listed = sorted(file.listed(), key=lambda one: -int(np.prod(one[1])))[:_MOST_SHOWN]
    rows: list[Row] = [(f"array {name}", _size(size), kind) for name, size, kind in listed]
    try:
        return _recording(file, settings, rows)
    except InvalidInputError as error:
        return Recording(path, settings, rows=tuple(rows), fault=error)


class _Variables(ABC):
    """Variables of a file: arrays in structs, struct arrays and cells."""

    is_reversed: bool
    """Whether arrays have their axes in reverse of MATLAB's."""
    root: Any

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def children(self, node: Any) -> Iterator[tuple[str, Any]]:
        """What is inside a node, and what MATLAB adds to its name; nothing for an only struct."""

    @abstractmethod
    def is_numeric(self, node: Any) -> bool:
        """Whether a node is an array of numbers."""

    def array(self, name: str) -> Any:
        """The array of a name as MATLAB's.

        Raises
        ------
        InvalidInputError
            If there is none of numbers.
        """
        node, rest = self.root, name.replace(" ", "")
        while rest:
            step = next(
                ((label, child) for label, child in self.children(node) if _begins(rest, label)), None
            )
            if step is None and rest.startswith(("(1)", "{1}")):
                rest = rest[3:]
                continue
            if step is None:
                break
            node, rest = step[1], rest[len(step[0]) :]
        if rest or not self.is_numeric(node):
            held = ", ".join(text for text, *_ in self.listed()[:_MOST_SHOWN]) or "none"
            raise InvalidInputError(f"{self.path}: expected an array {printable(name)}, got {held}")
        return node

    def size(self, node: Any) -> tuple[int, ...]:
        """Lengths in MATLAB's order."""
        shape = tuple(int(length) for length in node.shape)
        return shape[::-1] if self.is_reversed else shape

    def listed(self) -> list[tuple[str, tuple[int, ...], str]]:
        """Names of arrays, their lengths in MATLAB's order, and their types."""
        return list(self._walk(self.root, "", 0))

    def _walk(self, node: Any, name: str, level: int) -> Iterator[tuple[str, tuple[int, ...], str]]:
        if self.is_numeric(node):
            if 0 not in node.shape:
                kind = f"complex {node.dtype['real']}" if node.dtype.names else str(node.dtype)
                yield printable(name), self.size(node), kind
            return
        elements = 0
        for label, child in self.children(node) if level <= _MOST_LEVELS else ():
            elements += label[:1] in ("(", "{")
            if elements <= _MOST_ELEMENTS:
                yield from self._walk(child, name + label, level + bool(label))


def _begins(name: str, label: str) -> bool:
    after = name[len(label) :]
    return name.startswith(label) and (not label or not after or after[0] in ".({")


class _Whole(_Variables):
    """Versions 5 to 7, read whole by SciPy."""

    is_reversed = False

    def __init__(self, path: Path) -> None:
        from scipy.io import loadmat

        super().__init__(path)
        damage = (IndexError, AttributeError, EOFError, SystemError, AssertionError, NameError, zlib.error)
        with warnings.catch_warnings(), reading(path):
            warnings.simplefilter("ignore")
            try:
                held = loadmat(path)
            except damage as error:
                raise FileError(f"{path}: cannot be read: {one_line(error)}") from error
        self.root = {name: value for name, value in held.items() if not name.startswith("__")}

    def children(self, node: Any) -> Iterator[tuple[str, Any]]:
        if isinstance(node, dict):
            yield from node.items()
        elif isinstance(node, np.void):
            yield from ((f".{name}", node[name]) for name in node.dtype.names or ())
        elif isinstance(node, np.ndarray) and (node.dtype.names or node.dtype == object):
            form = "{{{}}}" if not node.dtype.names else "({})" if node.size > 1 else ""
            yield from ((form.format(k), element) for k, element in enumerate(node.ravel("F"), start=1))

    def is_numeric(self, node: Any) -> bool:
        return isinstance(node, np.ndarray) and node.dtype.kind in "fiuc"


@dataclass(frozen=True)
class _Element:
    """One struct of a struct array in HDF5, whose fields are lists of references."""

    group: h5py.Group
    index: int


class _HDF5(_Variables):
    """Version 7.3, of which an array is read when it is asked for."""

    is_reversed = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.root = open_hdf5(path)

    def children(self, node: Any) -> Iterator[tuple[str, Any]]:
        if isinstance(node, _Element):
            for name in node.group:
                yield f".{name}", self._followed(member(node.group, name), node.index)
        elif isinstance(node, h5py.Dataset) and self._is_list(node):
            yield from ((f"{{{k + 1}}}", self._followed(node, k)) for k in range(node.size))
        elif isinstance(node, h5py.Group):
            fields = {str(name): member(node, str(name)) for name in node if not str(name).startswith("#")}
            lists = [value for value in fields.values() if self._is_list(value) and not self._class(value)]
            if lists and node.name != "/":
                yield from ((f"({k + 1})", _Element(node, k)) for k in range(lists[0].size))
            else:
                yield from (
                    (name if node.name == "/" else f".{name}", value) for name, value in fields.items()
                )

    def is_numeric(self, node: Any) -> bool:
        if not isinstance(node, h5py.Dataset) or node.shape is None or self._class(node) == "char":
            return False
        is_pair = (node.dtype.names or ()) == ("real", "imag")
        return (node.dtype.kind in "fiu" or is_pair) and "MATLAB_empty" not in node.attrs

    def _followed(self, node: h5py.Dataset, k: int) -> Any:
        with reading(self.path):
            return self.root[node[()].ravel()[k]]

    def _is_list(self, node: Any) -> bool:
        return isinstance(node, h5py.Dataset) and h5py.check_ref_dtype(node.dtype) is h5py.Reference

    def _class(self, node: h5py.Dataset) -> str:
        value = node.attrs.get("MATLAB_class", b"")
        return value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)


@dataclass(frozen=True)
class _Axes:
    """Axes of an array in MATLAB's order, with those of length 1 that MATLAB leaves out at its end."""

    size: tuple[int, ...]
    vector: int
    sample: int
    frame: int | None

    @classmethod
    def read(cls, text: str, size: tuple[int, ...]) -> _Axes:
        axes = [axis.strip() for axis in text.split(",")]
        named = [axis for axis in axes if axis != "-"]
        sound = {*named} <= {"sample", "vector", "frame"} and len({*named}) == len(named)
        if not sound or not {"sample", "vector"} <= {*named}:
            raise InvalidInputError(
                f"axes: expected sample, vector, frame and -, once each, got {printable(text)}"
            )
        full = size + (1,) * (len(axes) - len(size))
        if len(axes) < len(full):
            raise InvalidInputError(f"axes: expected {len(full)} of {_size(size)}, got {printable(text)}")
        if any(axis == "-" and length != 1 for axis, length in zip(axes, full, strict=True)):
            raise InvalidInputError(
                f"axes: expected - for axes of length 1, got {printable(text)} of {_size(size)}"
            )
        frame = axes.index("frame") if "frame" in axes else None
        return cls(full, axes.index("vector"), axes.index("sample"), frame)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, vectors, samples."""
        count = 1 if self.frame is None else self.size[self.frame]
        return count, self.size[self.vector], self.size[self.sample]

    def grid(self, is_reversed: bool) -> Grid:
        """How a frame's numbers become (vector, sample)."""
        rest = [i for i in range(len(self.size)) if i != self.frame]
        stored = rest[::-1] if is_reversed else rest
        places = stored.index(self.vector), stored.index(self.sample)
        return Grid(tuple(self.size[i] for i in stored), places)


@dataclass(frozen=True)
class _Greys:
    """Turns numbers into grey levels, refused where they are none."""

    grid: Grid

    def __call__(self, parts: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Make a frame."""
        made = self.grid(parts).astype(np.float64)
        if not ((made >= 0) & (made <= 255) & (made == np.rint(made))).all():
            raise InvalidInputError("bmode: expected grey levels, whole numbers from 0 to 255, got others")
        return made.astype(np.uint8)


def _recording(file: _Variables, settings: ImportSettings, rows: list[Row]) -> Recording:
    path, arrays = file.path, settings.arrays
    where = f"{path}: arrays"
    unknown = sorted(set(arrays) - {*_DATA, *_POSITIONS, *_NUMBERS, "axes"})
    if unknown:
        raise InvalidInputError(f"{where}: expected {', '.join(_DATA)}, axes, got {printable(unknown[0])}")
    data = [name for name in _DATA if name in arrays]
    if data not in (["rf"], ["iq"], ["i", "q"], ["bmode"]):
        listed = (
            ", ".join(f"{name.removeprefix('array ')} {size} {kind}" for name, size, kind in rows) or "none"
        )
        raise InvalidInputError(
            f"{path}: expected to be told which array is what: write rf (or iq, or i and q, or bmode) = "
            f'"NAME" and axes = "sample, vector, frame" below [arrays] in {path.name}.toml beside it; there '
            f"are {' and '.join(data) + ' of ' if data else ''}{listed}"
        )
    names = [arrays[name] for name in data]
    nodes = [file.array(name) for name in names]
    size = file.size(nodes[0])
    if any(file.size(node) != size for node in nodes):
        raise InvalidInputError(
            f"{where}: expected arrays of one size, got {', '.join(_size(file.size(n)) for n in nodes)}"
        )
    if "axes" not in arrays:
        raise InvalidInputError(
            f"{where}: {printable(names[0])} is {_size(size)}: say which of its axes is which by axes = "
            f'"sample, vector, frame" in {path.name}.toml'
        )
    with naming(where):
        axes = _Axes.read(arrays["axes"], size)
        is_complex = nodes[0].dtype.kind == "c" or bool(nodes[0].dtype.names)
        if is_complex != (data == ["iq"]):
            got = "complex" if is_complex else "real"
            raise InvalidInputError(
                f"{data[0]}: expected {'real' if is_complex else 'complex'}, got {got} ones"
            )
    if 0 in axes.shape:
        raise InvalidInputError(f"{path}: {names[0]}: expected echoes, got size {_size(size)}")
    frames = _frames(file, nodes, axes, data)
    values, spacing, times = _numbers(file, arrays, axes.shape)
    rows += [("read", f"{name}: {arrays[name]} {_size(size)}", str(nodes[0].dtype)) for name in data]
    rows.append(("axes", arrays["axes"], ""))
    if not file.is_reversed:
        rows.append(("frames", "held in memory: MATLAB 7.3 files are read one by one", ""))
    remarks: list[str] = []
    if times is not None and settings.frame_rate_hz is None:
        chosen = rising(times)
        remarks = left_out(
            "images",
            times.size,
            {"without a time after the one before": times.size - chosen.size},
            times[chosen],
        )
        times = times[chosen]
        frames = (
            FileFrames(path, frames.open_file, axes.shape, frames.dtype, None, chosen.tolist())
            if isinstance(frames, FileFrames)
            else np.asarray(frames)[chosen]
        )
    return Recording(
        path,
        settings,
        frames,
        values,
        sample_spacing_mm=spacing,
        time_s=times,
        rows=tuple(rows),
        remarks=tuple(remarks),
    )


def _frames(file: _Variables, nodes: list[Any], axes: _Axes, data: list[str]) -> Frames:
    dtype: Any = np.float32
    if data == ["bmode"]:
        dtype = np.uint8
    elif data != ["rf"]:
        dtype = np.complex64
    elif nodes[0].dtype in (np.int8, np.uint8, np.int16):
        dtype = np.int16
    grid = axes.grid(file.is_reversed)
    turn = _Greys(grid) if data == ["bmode"] else grid
    if file.is_reversed:
        has_axis = axes.frame is not None and axes.frame < nodes[0].ndim
        axis = nodes[0].ndim - 1 - axes.frame if has_axis and axes.frame is not None else None
        source = HDF5File(file.path, tuple(node.name for node in nodes), axis, turn)
        return source.frames(axes.shape, dtype)
    full = [node.reshape(axes.size) for node in nodes]
    by_frame = [part[None] if axes.frame is None else np.moveaxis(part, axes.frame, 0) for part in full]
    made = np.empty(axes.shape, dtype)
    for i in range(axes.shape[0]):
        made[i] = turn([part[i] for part in by_frame])
    if made.dtype.kind in "fc":
        require_finite(made, f"{file.path}: {data[0]}")
    return made


def _numbers(
    file: _Variables, arrays: dict[str, str], shape: tuple[int, int, int]
) -> tuple[dict[str, Value], float | None, FloatArray | None]:
    """Numbers that arrays give, the distance between samples if z_mm gives it, and times."""
    values = {}
    for name in filter(arrays.__contains__, _NUMBERS):
        numbers = _scaled(file, name, arrays[name])
        wanted = 2 if name == "bandwidth_hz" else 1
        if numbers.size != wanted and not (wanted == 1 and numbers.size and (numbers == numbers[0]).all()):
            where = f"{file.path}: {name} = {printable(arrays[name])}"
            raise InvalidInputError(f"{where}: expected {wanted} number(s), got {numbers.size}")
        value = (float(numbers[0]), float(numbers[1])) if wanted == 2 else float(numbers[0])
        values[name] = Value(value, f"in {arrays[name]}")
    placed = {
        name: _scaled(file, name, arrays[name], name != "time_s") for name in _POSITIONS if name in arrays
    }
    for name, length, words in zip(
        _POSITIONS, (shape[1], shape[2], shape[0]), ("vectors", "samples", "frames"), strict=True
    ):
        if name in placed and placed[name].size != length:
            raise InvalidInputError(
                f"{file.path}: {name} = {printable(arrays[name])}: expected {length} numbers for {length} "
                f"{words}, got {placed[name].size}: are axes = {printable(arrays['axes'])} in this order?"
            )
    spacing = None
    if "x_mm" in placed:
        pitch = Value(step_of(placed["x_mm"], f"{file.path}: x_mm"), f"in {arrays['x_mm']}")
        values |= {"vector_pitch_mm": pitch, "column_pitch_mm": pitch}
    if "z_mm" in placed:
        spacing = step_of(placed["z_mm"], f"{file.path}: z_mm")
        values["row_spacing_mm"] = Value(spacing, f"in {arrays['z_mm']}")
        values["first_sample_depth_mm"] = Value(float(placed["z_mm"][0]), f"in {arrays['z_mm']}")
    return values, spacing, placed.get("time_s")


def _scaled(file: _Variables, name: str, text: str, is_finite: bool = True) -> FloatArray:
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
    with reading(file.path):
        values = np.asarray(file.array(parts["name"])[()])
    if values.dtype.kind not in "fiu" or (is_finite and not np.isfinite(values).all()):
        raise InvalidInputError(
            f"{file.path}: {name} = {printable(text)}: expected finite numbers, got others"
        )
    flat = values.astype(np.float64).ravel("C" if file.is_reversed else "F")
    return flat * factor if parts["sign"] == "*" else flat / factor


def _size(size: tuple[int, ...]) -> str:
    return " x ".join(map(str, size))


READER = Reader(FORMAT, _claims, open_matlab)
