"""What a sequence says beside its pixels: kept with a sweep, in the group ``/plus`` of a sweep file.

Members of ``/plus``: `field_names` and `field_values`, the fields of the whole file as text; ``frames/NAME``,
a field of every frame: float64 (n, 4, 4) for a transform, float64 (n,) for a time stamp, else text (n,);
``present/NAME``, bool (n,), where some frames lack a field. Attributes: `poses`, of which transforms
``/tracker`` was made; `conjugated`, whether the sign of Q was turned on reading. All n frames of the sequence
are there, also those whose image is not valid and not in the sweep.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np

from speckle3d.core.arrays import BoolArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.hdf5 import (
    find_group,
    has_member,
    locate,
    read_attribute,
    read_checked,
    read_text,
    read_texts,
    require_dataset,
    require_group,
)
from speckle3d.io.headers import SequenceHeader
from speckle3d.io.pixels import meta_type
from speckle3d.io.plus.layout import Layout

GROUP = "plus"

_STORAGE = {
    "ObjectType", "BinaryData", "BinaryDataByteOrderMSB", "ElementByteOrderMSB", "CompressedData",
    "HeaderSize", "CompressedDataSize", "DimSize", "ElementNumberOfChannels", "ElementSize", "Kinds",
    "ElementDataFile", "dimension", "encoding", "endian", "kinds", "sizes", "type", "spacings", "data file",
    "datafile", "space dimension", "space directions", "space origin", "space", "labels", "units",
    "DataNodeClassName", "axis 3 index type", "axis 3 index values", "axis 0 index type",
    "axis 0 index values",
}  # fmt: skip
"""Fields that say how pixels are stored; a writer makes them anew."""


_FIELD_NAME = re.compile(r"[\w.-](?:[\w. -]*[\w.-])?")
_FRAME_FIELD_NAME = re.compile(r"\w+")


@dataclass(frozen=True)
class SequenceRecord:
    """Fields of a sequence.

    Attributes
    ----------
    fields : dict
        Of the whole file, those of its storage left out; by MetaImage's names also where it was NRRD.
    frames : tuple of dict
        Of each frame, without the ``Seq_FrameNNNN_`` before their names.
    poses : tuple of str
        Names of the transforms that made the sweep's tracker: the tool's and the reference's, or "none".
    conjugated : bool
        Whether Q of the sweep has the other sign than in the file.
    """

    fields: Mapping[str, str] = field(default_factory=dict)
    frames: Sequence[Mapping[str, str]] = ()
    poses: tuple[str, ...] = ()
    conjugated: bool = False

    @property
    def has_image(self) -> BoolArray:
        """Which frames have a valid image, shape (n,)."""
        return valid_images(self.frames)


def record_of(
    header: SequenceHeader, layout: Layout, poses: tuple[str, ...] = (), conjugated: bool = False
) -> SequenceRecord:
    """Take the fields of a header that say more than how pixels are stored."""
    own = {name: value for name, value in header.fields.items() if name not in _STORAGE}
    spacing = " ".join(map(number_text, header.spacing_mm or (1.0, 1.0)))
    origin = header.fields.get("space origin", "").strip("()").replace(",", " ").split()
    standard = {
        **({"Offset": " ".join([*origin, "0"])} if {*origin} - {"0"} else {}),
        "NDims": str(len(header.size)),
        "UltrasoundImageOrientation": layout.orientation,
        "UltrasoundImageType": layout.kind,
        "ElementType": f"MET_{meta_type(header.pixels.dtype)}",
        "ElementSpacing": f"{spacing} 1" if len(header.size) == 3 else spacing,
    }
    return SequenceRecord(standard | own, header.frames, poses, conjugated)


def valid_images(frames: Sequence[Mapping[str, str]]) -> BoolArray:
    """Which frames have a valid image, shape (n,); older files of PLUS say so in Status alone."""
    return valid_frames(frames, "ImageStatus", "Status")


def valid_frames(frames: Sequence[Mapping[str, str]], *names: str) -> BoolArray:
    """Which frames say OK, or nothing, under each of the names of a status, shape (n,)."""
    return np.array([all(each.get(name, "OK") == "OK" for name in names) for each in frames], dtype=bool)


def number_text(value: float) -> str:
    """Write a number so that reading gives it back exactly."""
    return repr(float(value)).removesuffix(".0")


def write_record(file: h5py.File, record: SequenceRecord) -> None:
    """Write ``/plus`` into a sweep file."""
    group = file.create_group(GROUP)
    group.attrs["poses"] = " ".join(record.poses)
    group.attrs["conjugated"] = int(record.conjugated)
    group.create_dataset("field_names", data=list(record.fields), dtype=h5py.string_dtype())
    group.create_dataset("field_values", data=list(record.fields.values()), dtype=h5py.string_dtype())
    for name in sorted({name for each in record.frames for name in each}):
        texts = [each.get(name) for each in record.frames]
        values = _numbers(name, [text for text in texts if text is not None])
        present = np.array([text is not None for text in texts])
        if values is None:
            filled = ["" if text is None else text for text in texts]
            group.create_dataset(f"frames/{name}", data=filled, dtype=h5py.string_dtype())
        else:
            whole = np.zeros((len(texts), *values.shape[1:]))
            whole[present] = values
            group[f"frames/{name}"] = whole
        if not present.all():
            group[f"present/{name}"] = present


def read_record(file: h5py.File) -> SequenceRecord | None:
    """Read ``/plus`` of a sweep file; None where there is none.

    Raises
    ------
    FileError, InvalidInputError
        Naming the data set that does not make sense.
    """
    group = find_group(file, GROUP)
    if group is None:
        return None
    count = len(require_dataset(group, "field_names"))
    names, values = (read_texts(group, f"field_{each}", (count,)) for each in ("names", "values"))
    columns = _columns(group) if has_member(group, "frames") else {}
    frames = {len(texts) for texts in columns.values()}
    if len(frames) > 1:
        raise InvalidInputError(f"{locate(group, 'frames')}: expected as many values of each, got {frames}")
    rows: list[Mapping[str, str]] = [
        {name: texts[i] for name, texts in columns.items() if texts[i] is not None}
        for i in range(max(frames, default=0))
    ]
    fields = dict(zip(names, values, strict=True))
    _require_lines(locate(group, "field_names"), _FIELD_NAME, fields.items())
    for row in rows:
        _require_lines(locate(group, "frames"), _FRAME_FIELD_NAME, row.items())
    poses = tuple(read_text(group, "poses").split())
    return SequenceRecord(fields, tuple(rows), poses, bool(read_attribute(group, "conjugated", default=0)))


def _require_lines(where: str, pattern: re.Pattern[str], fields: Iterable[tuple[str, str]]) -> None:
    """Refuse names and values that would be other lines of a header than those of a field."""
    for name, value in fields:
        if not pattern.fullmatch(name) or name in _STORAGE or len(f"{value} ".splitlines()) > 1:
            raise InvalidInputError(f"{where}: expected fields of one line, got {name!r} = {value!r}")


def _columns(group: h5py.Group) -> dict[str, list[Any]]:
    """Texts of each field by frame; None where a frame lacks it."""
    inner = require_group(group, "frames")
    present = find_group(group, "present")
    columns = {}
    for name in inner:
        texts = _texts(inner, name)
        if present is not None and has_member(present, name):
            there = read_checked(present, name, (len(texts),), np.bool_)
            texts = [text if given else None for text, given in zip(texts, there, strict=True)]
        columns[name] = texts
    return columns


def _texts(group: h5py.Group, name: str) -> list[Any]:
    node = require_dataset(group, name)
    if node.dtype.kind != "f":
        return list(read_texts(group, name, (len(node),)))
    shape: tuple[int | str, ...] = ("frame",) if node.ndim == 1 else ("frame", 4, 4)
    values = read_checked(group, name, shape).reshape(len(node), -1)
    return [" ".join(map(number_text, row)) for row in values.tolist()]


def _numbers(name: str, texts: Sequence[str]) -> Any:
    """Values of a transform or time stamp by frame; None if it is another field, or not all finite."""
    size = 16 if name.endswith("Transform") else 1 if name.endswith("Timestamp") else 0
    try:
        values = np.array([[float(word) for word in text.split()] for text in texts])
    except ValueError:
        return None
    if not size or values.ndim != 2 or values.shape[1] != size or not np.isfinite(values).all():
        return None
    return values.reshape(-1, 4, 4) if size == 16 else values[:, 0]
