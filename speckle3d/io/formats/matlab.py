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

import math
import re
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.io.formats.hdf5_values import Turn, frame_of
from speckle3d.io.frames import FileFrames, HDF5Slices, ReadFrame
from speckle3d.io.hdf5 import SIGNATURE, find_member, open_hdf5, read_text, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader, first_bytes
from speckle3d.io.recordings import Facts, Recording, Value, step_of

FORMAT = "MATLAB"
USER_BLOCK = 512
"""Bytes of text before the HDF5 part of version 7.3."""

_DATA = (("rf",), ("iq",), ("i", "q"), ("bmode",))
_ROLES = {role for data in _DATA for role in data}
_POSITIONS = {"x_mm", "z_mm", "time_s"}
_TERM = re.compile(r"([^*/]+?)\s*(?:([*/])\s*([-+]?\d+\.?\d*(?:[eE][-+]?\d+)?))?")
_MOST = 12
"""Arrays that are told of, and elements of a list in which they are looked for."""


def _is_new(start: bytes) -> bool:
    return start[USER_BLOCK:].startswith(SIGNATURE)


def _claims(_: Path, start: bytes) -> bool:
    return start.startswith(b"MATLAB") and (_is_new(start) or start[126:128] in (b"IM", b"MI"))


def open_matlab(path: Path, settings: ImportSettings) -> Facts:
    """Read the arrays that a mapping names; without one, list the arrays and what to write."""
    variables: Any = open_hdf5(path) if _is_new(first_bytes(path)) else _variables(path)
    largest = sorted(_arrays(variables), key=lambda row: -math.prod(row[1].shape))[:_MOST]
    rows = [(name, _size(node), _kind(node)) for name, node in largest]
    yield from ((f"array {name}", size, kind) for name, size, kind in rows)
    arrays, where = settings.arrays, f"{path}: arrays"
    if unknown := sorted({*arrays} - _ROLES - _POSITIONS - {*ImportSettings.model_fields, "axes"}):
        raise InvalidInputError(f"{where}: expected {', '.join(sorted(_ROLES))}, axes, got {unknown[0]}")
    data = next((data for data in _DATA if {*data} == _ROLES & {*arrays}), None)
    if data is None:
        listing = ", ".join(map(" ".join, rows))
        raise InvalidInputError(
            f"{path}: expected to be told which array is what: write rf (or iq, or i and q, or bmode) = "
            f'"NAME" and axes = "sample, vector, frame" below [arrays] in {path.name}.toml beside it; there '
            f"are {listing or 'none'}"
        )
    with naming(where):
        nodes = [_array(variables, arrays[role]) for role in data]
        if len({node.shape for node in nodes}) > 1:
            raise InvalidInputError(f"expected arrays of one size, got {' and '.join(map(_size, nodes))}")
        if _kind(nodes[0]).startswith("complex") != (data == ("iq",)):
            raise InvalidInputError(f"{data[0]}: expected complex numbers as iq alone, got {_kind(nodes[0])}")
        names, shape = _axes(arrays.get("axes", ""), nodes[0])
        values, times = _numbers(variables, arrays, shape)
    return Recording(path, settings, _frames(path, nodes, names, shape, data[0]), values, time_s=times)


def _variables(path: Path) -> dict[str, Any]:
    """Variables of versions 5 to 7, read whole by SciPy."""
    from scipy.io import loadmat

    with warnings.catch_warnings(), reading(path, Exception):
        warnings.simplefilter("ignore")
        return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}


def _array(variables: Any, name: str) -> Any:
    """Find the array of a MATLAB name; the index of a single struct may be left out.

    Raises
    ------
    InvalidInputError
        If there is none of numbers.
    """
    node = variables
    # A field of an array of structs is the list of its elements' fields.
    for key in re.findall(r"\w+", re.sub(r"\((\d+)\)\.(\w+)", r".\2(\1)", name)):
        node = _open(node, _children(node).get(key, node if key == "1" else None))
        while [*(children := _children(node))] == ["1"]:
            node = _open(node, children["1"])
    if (array := _numeric(node)) is None:
        names = ", ".join(label for label, _ in _arrays(variables)) or "none"
        raise InvalidInputError(f"expected an array {name}, got {names}")
    return array


def _arrays(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield arrays of numbers with their names, of the first elements of each list."""
    if (array := _numeric(node)) is not None:
        yield name, array
        return
    children = _children(node)
    for key, child in children.items():
        if not key.isdecimal():
            yield from _arrays(child, f"{name}.{key}".lstrip("."))
        elif int(key) <= _MOST:
            yield from _arrays(_open(node, child), name + f"{{{key}}}" * (len(children) > 1))


def _children(node: Any) -> Mapping[str, Any]:
    """Fields by their names, and elements of a list, which may be references, by their numbers from 1."""
    if isinstance(node, dict):
        return node
    if isinstance(node, h5py.Group):
        return {name: find_member(node, name) for name in node if not name.startswith("#")}
    if isinstance(node, np.ndarray) and node.dtype.names:
        return {name: node[name] for name in node.dtype.names}
    if not isinstance(node, np.ndarray | h5py.Dataset) or node.dtype != object:
        return {}
    elements = node.T if isinstance(node, np.ndarray) else np.asarray(node[()])
    return {str(k): element for k, element in enumerate(elements.ravel(), 1)}


def _open(node: Any, child: Any) -> Any:
    return node.file[child] if isinstance(child, h5py.Reference) else child


def _numeric(node: Any) -> Any:
    """Array of numbers, with its axes in reverse; None of others."""
    if isinstance(node, np.ndarray):
        return node.T if node.dtype.kind in "fiuc" and node.size else None
    if not isinstance(node, h5py.Dataset) or not node.size or "MATLAB_empty" in node.attrs:
        return None
    is_number = node.dtype.kind in "fiu" or node.dtype.names == ("real", "imag")
    return node if is_number and read_text(node, "MATLAB_class", "") != "char" else None


def _greys(*parts: AnyArray, turn: Turn) -> AnyArray:
    """Turn numbers into grey levels, refused where they are none."""
    frame = turn(*parts)
    if not np.isin(frame, np.arange(256)).all():
        raise InvalidInputError("bmode: expected grey levels, whole numbers from 0 to 255, got others")
    return frame.astype(np.uint8)


def _axes(text: str, node: Any) -> tuple[list[str], tuple[int, int, int]]:
    """Names of axes in the file's order, and numbers of frames, vectors and samples."""
    names = [name.strip() for name in text.split(",")]
    sizes = [*node.shape[::-1], *(1,) * (len(names) - node.ndim)]  # MATLAB leaves out last ones of length 1
    lengths = {name: size for name, size in zip(names, sizes, strict=False) if name != "-"}
    whole = {"frame": 1} | lengths
    if {*whole} != {"frame", "vector", "sample"} or math.prod(lengths.values()) != node.size:
        raise InvalidInputError(
            f"axes: expected sample, vector, frame once each, and - for axes of length 1, of {_size(node)}, "
            f"got {text or 'none'}"
        )
    return names[: node.ndim][::-1], (whole["frame"], whole["vector"], whole["sample"])


def _frames(
    path: Path, nodes: list[Any], names: list[str], shape: tuple[int, int, int], role: str
) -> FileFrames:
    is_short = nodes[0].dtype in (np.int8, np.uint8, np.int16)
    dtypes: dict[str, Any] = {"bmode": np.uint8, "rf": np.int16 if is_short else np.float32}
    dtype = dtypes.get(role, np.complex64)
    turn: Turn = partial(frame_of, shape=shape[1:], across=names.index("vector") > names.index("sample"))
    if role == "bmode":
        turn = partial(_greys, turn=turn)
    axis = names.index("frame") if "frame" in names else None
    source: Any = partial(_slices, nodes, turn, axis)
    if isinstance(nodes[0], h5py.Dataset):
        source = HDF5Slices(path, tuple(node.name for node in nodes), turn, axis)
    return FileFrames(path, source, shape, dtype)


def _slices(nodes: list[AnyArray], turn: Turn, axis: int | None) -> ReadFrame:
    """Frames of arrays in memory."""
    return lambda i: turn(*(node if axis is None else node.take(i, axis) for node in nodes))


def _numbers(
    variables: Any, arrays: Mapping[str, str], shape: tuple[int, int, int]
) -> tuple[dict[str, Value], FloatArray | None]:
    """Numbers that arrays give, and times."""
    values, times = dict[str, Value](), None
    lengths = {"time_s": shape[0], "x_mm": shape[1], "z_mm": shape[2], "bandwidth_hz": 2}
    for name in sorted({*arrays} - {*_ROLES, "axes"}):
        numbers, source = _product(variables, name, arrays[name]), f"in {arrays[name]}"
        count = lengths.get(name, 1)
        if name not in lengths and np.ptp(numbers) == 0:
            numbers = numbers[:1]
        if numbers.size != count:
            raise InvalidInputError(
                f"{name} = {arrays[name]}: expected {count} number(s), got {numbers.size}: "
                f"are axes = {arrays['axes']} in this order?"
            )
        if name == "time_s":
            times = numbers
        elif name == "x_mm":
            values["vector_pitch_mm"] = Value(step_of(numbers, name), source)
        elif name == "z_mm":
            values["row_spacing_mm"] = Value(step_of(numbers, name), source)
            values["first_sample_depth_mm"] = Value(float(numbers[0]), source)
        else:
            values[name] = Value(tuple(numbers.tolist()) if count > 1 else float(numbers[0]), source)
    return values, times


def _product(variables: Any, name: str, text: str) -> FloatArray:
    """Numbers of an array, in one row, times the factor behind its name."""
    parts = _TERM.fullmatch(text.strip())
    factor = float(parts[3] or 1.0) if parts else 0.0
    if not parts or not factor:
        raise InvalidInputError(f"{name}: expected as NAME, NAME * 1e6 or NAME / 2, got {text}")
    numbers = np.asarray(_array(variables, parts[1])[()], dtype=np.float64).ravel()
    return numbers / factor if parts[2] == "/" else numbers * factor


def _size(node: Any) -> str:
    return " x ".join(map(str, node.shape[::-1]))


def _kind(node: Any) -> str:
    return f"complex {node.dtype['real']}" if node.dtype.names else str(node.dtype)


READER = Reader(FORMAT, _claims, open_matlab)
