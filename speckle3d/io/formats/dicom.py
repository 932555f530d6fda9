"""Multi-frame B-mode in DICOM files, read by pydicom (DICOM PS3.3, C.8.5.5, C.8.5.6, C.7.6.5, C.7.6.6).

Where the file describes its regions (Sequence of Ultrasound Regions), the image is cropped to the region of
2-D tissue, whose Physical Delta X and Y give the size of a pixel: both in cm, so that the image is
Cartesian, a sector with black corners too. Without regions, Pixel Spacing gives it. Elements that name a
patient are never loaded.
"""

from __future__ import annotations

import struct
import warnings
from bisect import bisect
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.files import open_regular
from speckle3d.core.printable import printable
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import one_line, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, differs

FORMAT = "DICOM"

_MARK, _MARK_BYTE = b"DICM", 128
_TISSUE, _CM = (1, 1), (3.0, 3.0)
"""Region Spatial Format and Data Type of 2-D tissue, and Physical Units of both directions."""
_LOSSY_SPREAD = 12
"""Levels by which the colours of a grey pixel may differ after lossy packing; the tint of a colour map is
more."""
_LONGEST = 64
"""Letters of an element that are shown: those of a name of a kind; DICOM allows no more."""
_RATES = ("FrameTime", "CineRate", "RecommendedDisplayFrameRate")
_EIGHT_BITS = {"BitsAllocated": 8, "BitsStored": 8, "PixelRepresentation": 0}
_CORNERS = ("MinX0", "MinY0", "MaxX1", "MaxY1")
_COLOURS = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
_TAGS = (
    "SOPClassUID", "Modality", "Manufacturer", "ManufacturerModelName", "TransducerData", "TransducerType",
    "NumberOfFrames", "FrameTimeVector", *_RATES, "SamplesPerPixel", "PhotometricInterpretation", "Rows",
    "Columns", "PlanarConfiguration", *_EIGHT_BITS, "PixelSpacing", "LossyImageCompression",
    "SequenceOfUltrasoundRegions",
)  # fmt: skip
"""All that is loaded."""


@dataclass(frozen=True)
class _Region:
    """Part of the image: first and last column and row, size of a pixel, and how it is turned."""

    left: int
    top: int
    right: int
    bottom: int
    kind: tuple[int, int] = _TISSUE
    units: tuple[float, float] = _CM
    delta_cm: tuple[float, float] = (1.0, 1.0)
    reference_y: tuple[float, float] | None = None

    def __str__(self) -> str:
        kind = "2-D tissue" if self.kind == _TISSUE else "RegionSpatialFormat {}, RegionDataType {}"
        place = f"columns {self.left} to {self.right}, rows {self.top} to {self.bottom}"
        return f"{kind.format(*self.kind)} ({place})"


@dataclass(frozen=True)
class DicomFile:
    """Decodes grey frames of a region, one at a time."""

    path: Path
    region: _Region
    inverted: bool
    spread: int

    def __call__(self) -> ReadFrame:
        """Open nothing: each frame is read from the file anew."""
        return self.read

    def read(self, i: int) -> npt.NDArray[Any]:
        """Decode frame i, shape (column, row)."""
        region = self.region
        image = _decoded(self.path, i)[region.top : region.bottom + 1, region.left : region.right + 1]
        grey = _grey(image, self.spread).T
        grey = 255 - grey if self.inverted else grey
        return grey[:, ::-1] if region.delta_cm[1] < 0 else grey


def open_dicom(path: Path, settings: ImportSettings) -> Recording:
    """Read grey images of eight bits; they stay in the file until they are asked for."""
    header, rows = _header(path)
    return Recording.of(path, settings, rows, lambda: _recording(path, settings, header, rows))


def _recording(path: Path, settings: ImportSettings, header: Any, rows: list[Row]) -> Recording:
    count = _require_grey(path, header)
    region, values = _place(path, header, rows)
    kind = _text(header, "PhotometricInterpretation")
    lossy = _text(header, "LossyImageCompression") == "01" or "YBR" in kind
    source = DicomFile(path, region, kind == "MONOCHROME1", _LOSSY_SPREAD if lossy else 0)
    shape = (count, region.right - region.left + 1, region.bottom - region.top + 1)
    _require_all_frames(path, count)
    frames = FileFrames(path, source, shape, np.uint8)
    _ = frames[count // 2]  # colour is told before a reconstruction begins
    times, values["frame_rate_hz"], remarks = _clock(header, count)
    return Recording(path, settings, frames, values, time_s=times, remarks=remarks)


def _header(path: Path) -> tuple[Any, list[Row]]:
    """Elements beside the pixels, and what they say of the machine."""
    pydicom = extra_module("pydicom", "dicom", f"{path}: DICOM")
    with _reading(str(path)), open_regular(path) as stream:
        syntax = pydicom.filereader.read_file_meta_info(path).get("TransferSyntaxUID")
        if syntax is None:
            raise InvalidInputError(f"{path}: expected a transfer syntax, got none")
        header = pydicom.dcmread(stream, stop_before_pixels=True, specific_tags=list(_TAGS))
        for name in _TAGS:  # elements are read from their bytes when first asked for
            header.get(name)
    scanner, transducer = (
        f"{_text(header, first)} {_text(header, second)}".strip()
        for first, second in (("Manufacturer", "ManufacturerModelName"), ("TransducerType", "TransducerData"))
    )
    rows = [row for row in (("scanner", scanner, ""), ("transducer", transducer, "")) if row[1]]
    rows.append(("transfer syntax", printable(str(syntax.name)), ""))
    if _text(header, "LossyImageCompression") == "01":
        rows.append(("pixels", "packed with loss, which smooths speckle", ""))
    return header, rows


@contextmanager
def _reading(where: str) -> Iterator[None]:
    """Turn what pydicom raises on damaged files into one line, and keep its warnings to itself."""
    import pydicom.config
    from pydicom.errors import BytesLengthException, InvalidDicomError

    damage = (AttributeError, IndexError, EOFError, AssertionError, struct.error)
    with reading(where), warnings.catch_warnings(), pydicom.config.disable_value_validation():
        warnings.simplefilter("ignore")
        try:
            yield
        except (*damage, BytesLengthException, InvalidDicomError) as error:
            raise FileError(f"{where}: cannot be read: {one_line(error)}") from error


def _decoded(path: Path, i: int) -> npt.NDArray[Any]:
    from pydicom.pixels.utils import pixel_array

    with _reading(f"{path}: frame {i}"), open_regular(path) as stream:
        return np.asarray(pixel_array(stream, index=i))


def _require_all_frames(path: Path, count: int) -> None:
    """Refuse a file that ends before its last frame, telling how many are whole."""

    def is_cut(i: int) -> bool:
        try:
            _decoded(path, i)
        except FileError:
            return True
        return False

    _decoded(path, 0)
    if is_cut(count - 1):
        whole = bisect(range(count), False, key=is_cut)
        raise FileError(f"{path}: ends early: {whole} of {count} frames")


def _require_grey(path: Path, header: Any) -> int:
    """Refuse what is no sequence of grey images of eight bits; returns the number of frames."""
    if (modality := _text(header, "Modality")) != "US":
        raise InvalidInputError(f"{path}: Modality: expected US, got {modality or 'none'}")
    count = int(_number(path, header, "NumberOfFrames", 1))
    if count < 2:
        raise InvalidInputError(f"{path}: NumberOfFrames: expected several frames, got a single image")
    greys = {1: ("MONOCHROME1", "MONOCHROME2"), 3: _COLOURS}.get(
        int(_number(path, header, "SamplesPerPixel", 1)), ()
    )
    if (kind := _text(header, "PhotometricInterpretation")) not in greys:
        raise InvalidInputError(
            f"{path}: PhotometricInterpretation: expected {' or '.join(greys)}, got {kind or 'none'}"
        )
    for name, expected in _EIGHT_BITS.items():
        if (got := _number(path, header, name, expected)) != expected:
            raise InvalidInputError(f"{path}: {name}: expected {expected}, got {got:g}")
    if not _number(path, header, "Rows", 0) * _number(path, header, "Columns", 0):
        raise InvalidInputError(f"{path}: expected an image, got no columns or no rows")
    return count


def _place(path: Path, header: Any, rows: list[Row]) -> tuple[_Region, dict[str, Value]]:
    """The part of the image to take and the size of its pixels; rows tell of it."""
    height, width = int(header.Rows), int(header.Columns)
    with _reading(str(path)):
        items = header.get("SequenceOfUltrasoundRegions") or ()
        regions = [_region(f"{path}: SequenceOfUltrasoundRegions[{i}]", item) for i, item in enumerate(items)]
        spacing = [float(value) for value in header.get("PixelSpacing") or ()]
    if not regions:
        rows.append(("region read", "the whole image, taken for Cartesian tissue: the file names none", ""))
        is_sized = len(spacing) == 2 and min(spacing) > 0 and np.isfinite(spacing).all()
        names = ("row_spacing_mm", "column_pitch_mm") if is_sized else ()
        values = {name: Value(mm, "PixelSpacing") for name, mm in zip(names, spacing, strict=False)}
        return _Region(0, 0, width - 1, height - 1), values
    tissue = [region for region in regions if region.kind == _TISSUE]
    if len(tissue) != 1:
        listed = "; ".join(map(str, regions))
        raise InvalidInputError(f"{path}: expected one region of 2-D tissue, got {len(tissue)} of {listed}")
    one = tissue[0]
    if not (0 <= one.left < one.right < width and 0 <= one.top < one.bottom < height):
        raise InvalidInputError(f"{path}: expected a region within {width} x {height} pixels, got {one}")
    if one.units != _CM or 0.0 in one.delta_cm:
        raise InvalidInputError(
            f"{path}: PhysicalUnits and PhysicalDelta of X and Y: expected units 3 and 3 (cm) and steps "
            f"other than 0, got {one.units} and {one.delta_cm}: a polar image has to be scan-converted first"
        )
    x_mm, y_mm = (10.0 * abs(delta) for delta in one.delta_cm)
    values = {
        "column_pitch_mm": Value(x_mm, "PhysicalDeltaX"),
        "row_spacing_mm": Value(y_mm, "PhysicalDeltaY"),
    }
    if one.reference_y is not None:
        pixel, value_cm = one.reference_y
        # The first row taken is the region's last where y falls.
        row = one.bottom - one.top if one.delta_cm[1] < 0 else 0
        depth_mm = 10.0 * (value_cm + (row - pixel) * one.delta_cm[1])
        values["first_sample_depth_mm"] = Value(depth_mm, "ReferencePixelY0 and its physical value")
    rows.append(("region read", str(one), ""))
    rows += [("region left out", str(other), "") for other in regions if other is not one]
    if one.delta_cm[0] < 0:
        rows.append(("columns", "run against the file's x (PhysicalDeltaX below 0): left as shown", ""))
    if one.delta_cm[1] < 0:
        rows.append(("rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", ""))
    return one, values


def _region(where: str, item: Any) -> _Region:
    def numbers(*names: str) -> tuple[float, float]:
        first, second = (_number(where, item, name) for name in names)
        return first, second

    place = [int(_number(where, item, f"RegionLocation{name}")) for name in _CORNERS]
    spatial, data = numbers("RegionSpatialFormat", "RegionDataType")
    region = _Region(place[0], place[1], place[2], place[3], (int(spatial), int(data)))
    if region.kind != _TISSUE:
        return region
    reference = ("ReferencePixelY0", "ReferencePixelPhysicalValueY")
    return replace(
        region,
        units=numbers("PhysicalUnitsXDirection", "PhysicalUnitsYDirection"),
        delta_cm=numbers("PhysicalDeltaX", "PhysicalDeltaY"),
        reference_y=None if None in map(item.get, reference) else numbers(*reference),
    )


def _clock(header: Any, count: int) -> tuple[FloatArray | None, Value, tuple[str, ...]]:
    """Times of the frames where each has its own, else their rate; and what contradicts."""
    with _reading("frame times"):
        vector = header.get("FrameTimeVector")
        steps = np.atleast_1d(np.asarray([] if vector is None else vector, dtype=float))
        numbers = {name: float(header.get(name) or 0.0) for name in _RATES}
    numbers["FrameTime"] = 1e3 / numbers["FrameTime"] if numbers["FrameTime"] else 0.0
    said = [(name, rate) for name, rate in numbers.items() if 0 < rate < np.inf]
    others = [f"{name} says {other:.4g}" for name, other in said[1:2] if differs(said[0][1], other)]
    rate = Value(said[0][1], ", ".join([said[0][0], *others])) if said else Value()
    if not steps.size:
        return None, rate, ()
    steps = steps if steps.size != count - 1 else np.concatenate([[0.0], steps])
    if steps.size != count or not np.isfinite(steps[1:]).all():
        words = f"FrameTimeVector: {steps.size} steps for {count} frames, or some that are no numbers"
        return None, rate, (f"{words}: not used",)
    return np.cumsum([0.0, *steps[1:]]) / 1e3, rate, ()


def _grey(image: npt.NDArray[Any], spread: int) -> npt.NDArray[np.uint8]:
    """Grey levels of an image, refused where a pixel has a colour."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise InvalidInputError(f"expected pixels of type uint8, got {image.dtype} {image.shape}")
    if image.ndim == 2:
        return image
    coloured = np.ptp(image.astype(np.int16), axis=2) > spread
    if coloured.any():
        row, column = np.argwhere(coloured)[0]
        raise InvalidInputError(
            f"expected grey, got {int(coloured.sum())} pixels of a colour, the first at column {column}, "
            f"row {row} of the region: colour Doppler or an overlay"
        )
    return np.asarray(np.rint(image.mean(axis=2)), dtype=np.uint8)


def _text(header: Any, name: str) -> str:
    """Words of an element, as they may be shown; none where there is no such element."""
    value = header.get(name)
    words = value if type(value).__name__ == "MultiValue" else [] if value is None else [value]
    text = " ".join(printable(" ".join(str(word).split())) for word in words).strip()
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _number(where: object, item: Any, name: str, default: float | None = None) -> float:
    """Number of an element; `default` where there is no such element, unless that is None."""
    value = item.get(name)
    try:
        number = float(value) if value is not None or default is None else default
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise InvalidInputError(f"{where}: {name}: expected a number, got {printable(str(value))}")
    return number


READER = Reader(FORMAT, lambda _, start: start[_MARK_BYTE:].startswith(_MARK), open_dicom)
