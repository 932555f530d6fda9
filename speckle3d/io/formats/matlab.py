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
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite
from speckle3d.core.sweep import Frames
from speckle3d.io.formats.hdf5_values import Turn, frame_of, text_of
from speckle3d.io.frames import HDF5Slices
from speckle3d.io.hdf5 import SIGNATURE, find_member, open_hdf5, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader, first_bytes
from speckle3d.io.recordings import Facts, Recording, Value, step_of

FORMAT = "MATLAB"
USER_BLOCK = 512
"""Bytes of text before the HDF5 part of version 7.3."""

_DATA = (("rf",), ("iq",), ("i", "q"), ("bmode",))
_ROLES = {role for data in _DATA for role in data}
_POSITIONS = ("x_mm", "z_mm", "time_s")
_TERM = re.compile(r"(?P<name>[^*/]+?)\s*(?:(?P<sign>[*/])\s*(?P<factor>[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?))?")
_MOST_ARRAYS, _MOST_ELEMENTS = 12, 8
"""Arrays that are told of, and elements of a list in which they are looked for."""


def _is_new(start: bytes) -> bool:
    return start[USER_BLOCK:].startswith(SIGNATURE)


def _claims(_: Path, start: bytes) -> bool:
    return start.startswith(b"MATLAB") and (_is_new(start) or start[126:128] in (b"IM", b"MI"))


def open_matlab(path: Path, settings: ImportSettings) -> Facts:
    """Read the arrays that a mapping names; without one, list the arrays and what to write."""
    variables: Any = open_hdf5(path) if _is_new(first_bytes(path)) else _variables(path)
    largest = sorted(_arrays(variables), key=lambda row: -int(np.prod(row[1].shape)))[:_MOST_ARRAYS]
    rows = [(name, _size(node), _kind(node)) for name, node in largest]
    yield from ((f"array {name}", size, kind) for name, size, kind in rows)
    arrays, where = settings.arrays, f"{path}: arrays"
    if unknown := sorted({*arrays} - {*_ROLES, *_POSITIONS, *ImportSettings.model_fields, "axes"}):
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
        lengths, names = _axes(arrays.get("axes", ""), nodes[0])
        shape = lengths["frame"], lengths["vector"], lengths["sample"]
        values, times = _numbers(variables, arrays, shape)
    return Recording(path, settings, _frames(path, nodes, names, shape, data), values, time_s=times)


def _variables(path: Path) -> dict[str, Any]:
    """Variables of versions 5 to 7, read whole by SciPy."""
    from scipy.io import loadmat

    with warnings.catch_warnings(), reading(path):
        warnings.simplefilter("ignore")
        return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}


def _array(variables: Any, name: str) -> Any:
    """Find the array of a MATLAB name; the index of a single struct may be left out.

    Raises
    ------
    InvalidInputError
        If there is none of numbers.
    """
    plain = name.replace(" ", "")
    for target in (plain, re.sub(r"[({]1[)}]", "", plain)):
        if (node := dict(_arrays(variables, target)).get(target)) is not None:
            return node
    names = ", ".join(label for label, _ in _arrays(variables)) or "none"
    raise InvalidInputError(f"expected an array {name}, got {names}")


def _arrays(node: Any, target: str = "", name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield numeric arrays with their names: those on the way to `target`, else the first of each list.

    All have their axes in reverse.
    """
    if _is_numeric(node):
        if 0 not in node.shape:
            yield name, node.T if isinstance(node, np.ndarray) else node
        return
    for k, (label, child) in enumerate(_children(node)):
        if target.startswith(name + label) if target else k < _MOST_ELEMENTS or label[:1] not in ("(", "{"):
            yield from _arrays(child, target, name + label)


def _children(node: Any) -> Iterator[tuple[str, Any]]:
    """Yield the children of a node with what MATLAB adds to its name, nothing for a single struct."""
    if isinstance(node, dict):
        yield from node.items()
    elif isinstance(node, np.void):
        yield from ((f".{name}", node[name]) for name in node.dtype.names or ())
    elif isinstance(node, np.ndarray) and (node.dtype.names or node.dtype == object):
        form = "{{{}}}" if not node.dtype.names else "({})" if node.size > 1 else ""
        yield from ((form.format(k), element) for k, element in enumerate(node.ravel("F"), start=1))
    elif _is_list(node):
        yield from ((f"{{{k + 1}}}", _element(node, k)) for k in range(node.size))
    elif isinstance(node, h5py.Group):
        dot = "" if node.name == "/" else "."
        fields = {f"{dot}{name}": find_member(node, name) for name in node if not str(name).startswith("#")}
        # Fields of a struct array are lists of references that are no cells.
        lists = [field for field in fields.values() if dot and _is_list(field) and not _class(field)]
        if not lists:
            yield from fields.items()
        for k in range(lists[0].size if lists else 0):
            yield f"({k + 1})", {name: _element(field, k) for name, field in fields.items()}


def _element(node: h5py.Dataset, k: int) -> Any:
    return node.file[node[()].ravel()[k]]


def _is_numeric(node: Any) -> bool:
    if isinstance(node, np.ndarray):
        return node.dtype.kind in "fiuc"
    if not isinstance(node, h5py.Dataset) or node.shape is None or "MATLAB_empty" in node.attrs:
        return False
    return _class(node) != "char" and (node.dtype.kind in "fiu" or node.dtype.names == ("real", "imag"))


def _is_list(node: Any) -> bool:
    return isinstance(node, h5py.Dataset) and h5py.check_ref_dtype(node.dtype) is h5py.Reference


def _class(node: h5py.Dataset) -> str:
    return text_of(node.attrs.get("MATLAB_class"))


def _greys(*parts: AnyArray, turn: Turn) -> AnyArray:
    """Turn numbers into grey levels, refused where they are none."""
    frame = turn(*parts)
    if not np.isin(frame, np.arange(256)).all():
        raise InvalidInputError("bmode: expected grey levels, whole numbers from 0 to 255, got others")
    return frame.astype(np.uint8)


def _axes(text: str, node: Any) -> tuple[dict[str, int], list[str]]:
    """Lengths of axes by their names, and the names in the file's order; - for axes of length 1."""
    names = [name.strip() for name in text.split(",")]
    sizes = [*node.shape[::-1], *(1,) * (len(names) - node.ndim)]  # MATLAB leaves out last ones of length 1
    axes = list(zip(names, sizes, strict=False))
    plain = sorted(name for name in names if name != "-")
    has_all = plain in (["frame", "sample", "vector"], ["sample", "vector"])
    if not has_all or len(sizes) > len(names) or any(name == "-" and size > 1 for name, size in axes):
        raise InvalidInputError(
            f"axes: expected sample, vector, frame once each, and - for axes of length 1, of {_size(node)}, "
            f"got {text or 'none'}"
        )
    return {"frame": 1} | dict(axes), names[: node.ndim][::-1]


def _frames(
    path: Path, nodes: list[Any], names: list[str], shape: tuple[int, int, int], data: tuple[str, ...]
) -> Frames:
    is_short = nodes[0].dtype in (np.int8, np.uint8, np.int16)
    dtypes: dict[str, Any] = {"bmode": np.uint8, "rf": np.int16 if is_short else np.float32}
    dtype = dtypes.get(data[0], np.complex64)
    across = [name for name in names if name in ("vector", "sample")][-1] == "vector"
    turn = partial(frame_of, shape=shape[1:], across=across)
    if data == ("bmode",):
        turn = partial(_greys, turn=turn)
    axis = names.index("frame") if "frame" in names else None
    if isinstance(nodes[0], h5py.Dataset):
        return HDF5Slices(path, tuple(node.name for node in nodes), turn, axis).frames(shape, dtype)
    frames = np.empty(shape, dtype)
    for i in range(shape[0]):
        frames[i] = turn(*(node if axis is None else node.take(i, axis) for node in nodes))
    if frames.dtype.kind in "fc":
        require_finite(frames, f"{path}: {data[0]}")
    return frames


def _numbers(
    variables: Any, arrays: Mapping[str, str], shape: tuple[int, int, int]
) -> tuple[dict[str, Value], FloatArray | None]:
    """Numbers that arrays give, and times."""
    values, times = dict[str, Value](), None
    lengths = {"x_mm": shape[1], "z_mm": shape[2], "time_s": shape[0], "bandwidth_hz": 2}
    for name in sorted({*arrays} & {*_POSITIONS, *ImportSettings.model_fields}):
        numbers, source = _product(variables, name, arrays[name]), f"in {arrays[name]}"
        if name not in lengths and np.ptp(numbers) == 0:
            numbers = numbers[:1]
        if numbers.size != lengths.get(name, 1):
            raise InvalidInputError(
                f"{name} = {arrays[name]}: expected {lengths.get(name, 1)} number(s), got {numbers.size}: "
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
            values[name] = Value(tuple(numbers.tolist()) if numbers.size > 1 else float(numbers[0]), source)
    return values, times


def _product(variables: Any, name: str, text: str) -> FloatArray:
    """Numbers of an array, in one row, times the factor behind its name."""
    parts = _TERM.fullmatch(text.strip())
    factor = float(parts["factor"] or 1.0) if parts else 0.0
    if parts is None or not factor:
        raise InvalidInputError(f"{name}: expected as NAME, NAME * 1e6 or NAME / 2, got {text}")
    values = np.asarray(_array(variables, parts["name"])[()])
    if values.dtype.kind not in "fiu" or (name != "time_s" and not np.isfinite(values).all()):
        raise InvalidInputError(f"{name} = {text}: expected finite numbers, got others")
    flat = values.astype(np.float64).ravel()
    return flat / factor if parts["sign"] == "/" else flat * factor


def _size(node: Any) -> str:
    return " x ".join(map(str, node.shape[::-1]))


def _kind(node: Any) -> str:
    return f"complex {node.dtype['real']}" if node.dtype.names else str(node.dtype)


READER = Reader(FORMAT, _claims, open_matlab)
