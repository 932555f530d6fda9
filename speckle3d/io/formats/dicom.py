"""Multi-frame B-mode in DICOM files, read by pydicom (DICOM PS3.3, C.8.5.5, C.8.5.6, C.7.6.5, C.7.6.6).

Where the file describes its regions (Sequence of Ultrasound Regions), the image is cropped to the region of
2-D tissue, whose Physical Delta X and Y give the size of a pixel: both in cm, so that the image is
Cartesian, a sector with black corners too. Without regions, Pixel Spacing gives it. Elements that name a
patient are never loaded.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
from speckle3d.io.pose_paths import left_out, rising
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, differs

FORMAT = "DICOM"

_MARK, _MARK_BYTE = b"DICM", 128
_SPATIAL = {0: "no image", 1: "2-D", 2: "M-mode", 3: "spectrum", 4: "wave form", 5: "graphics"}
_DATA = {
    0: "no data", 1: "tissue", 2: "colour flow", 3: "pulsed Doppler", 4: "continuous Doppler",
    5: "Doppler mean trace", 6: "Doppler mode trace", 7: "Doppler maximum trace", 8: "volume trace",
    10: "ECG", 11: "pulse", 12: "phonocardiogram", 13: "grey bar", 14: "colour bar",
    15: "integrated backscatter", 16: "area trace",
}  # fmt: skip
_UNIT_CM = 3
_LOSSY_SPREAD = 12
"""Levels by which the colours of a grey pixel may differ after lossy packing; the tint of a colour map is
more."""
_LONGEST = 64
"""Letters of an element that are shown: those of a name of a kind; DICOM allows no more."""
_TAGS = (
    "SOPClassUID", "Modality", "Manufacturer", "ManufacturerModelName", "TransducerData", "TransducerType",
    "ProcessingFunction", "NumberOfFrames", "FrameIncrementPointer", "FrameTime", "FrameTimeVector",
    "RecommendedDisplayFrameRate", "SamplesPerPixel", "PhotometricInterpretation", "Rows", "Columns",
    "CineRate", "PlanarConfiguration", "BitsAllocated", "BitsStored", "PixelRepresentation", "PixelSpacing",
    "LossyImageCompression", "SequenceOfUltrasoundRegions",
)  # fmt: skip
"""All that is loaded."""


@dataclass(frozen=True)
class _Region:
    """A region of the image: its kind, its place in pixels, last ones included, and what a pixel measures."""

    spatial: int
    data: int
    left: int
    top: int
    right: int
    bottom: int
    units: tuple[int, int] = (_UNIT_CM, _UNIT_CM)
    delta_cm: tuple[float, float] = (1.0, 1.0)
    reference_y: tuple[float, float] | None = None

    def __str__(self) -> str:
        kind = f"{_SPATIAL.get(self.spatial, self.spatial)} {_DATA.get(self.data, self.data)}"
        return f"{kind} (columns {self.left} to {self.right}, rows {self.top} to {self.bottom})"


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


def _claims(_: Path, start: bytes) -> bool:
    return start[_MARK_BYTE : _MARK_BYTE + len(_MARK)] == _MARK


def open_dicom(path: Path, settings: ImportSettings) -> Recording:
    """Read grey images of eight bits; they stay in the file until they are asked for."""
    header, syntax = _header(path)
    rows = _facts(header, syntax)
    try:
        return _recording(path, settings, header, rows)
    except (InvalidInputError, FileError) as error:
        return Recording(path, settings, rows=tuple(rows), fault=error)


def _recording(path: Path, settings: ImportSettings, header: Any, rows: list[Row]) -> Recording:
    count = _require_grey(path, header)
    region, values, notes = _place(path, header)
    kind = _text(header, "PhotometricInterpretation")
    lossy = _text(header, "LossyImageCompression") == "01" or "YBR" in kind
    source = DicomFile(path, region, kind == "MONOCHROME1", _LOSSY_SPREAD if lossy else 0)
    shape = (count, region.right - region.left + 1, region.bottom - region.top + 1)
    _require_all_frames(path, count)
    times, rate, remarks = _clock(header, count)
    chosen = np.arange(count) if times is None or settings.frame_rate_hz else rising(times)
    if times is not None:
        times = times[chosen]
        remarks += left_out("images", count, {"with a repeated time": count - chosen.size}, times)
    frames = FileFrames(path, source, shape, np.uint8, None, chosen.tolist())
    _ = frames[len(frames) // 2]  # colour is told before a reconstruction begins
    return Recording(
        path, settings, frames, {**values, "frame_rate_hz": rate}, time_s=times,
        rows=(*rows, *notes), remarks=tuple(remarks),
    )  # fmt: skip


def _header(path: Path) -> tuple[Any, Any]:
    """Elements beside the pixels, and the transfer syntax."""
    pydicom = extra_module("pydicom", "dicom", f"{path}: DICOM")
    with _reading(str(path)), open_regular(path) as stream:
        meta = pydicom.filereader.read_file_meta_info(path)
        syntax = meta.get("TransferSyntaxUID")
        if syntax is None:
            raise InvalidInputError(f"{path}: expected a transfer syntax, got none")
        header = pydicom.dcmread(stream, stop_before_pixels=True, specific_tags=list(_TAGS))
        for name in _TAGS:  # elements are read from their bytes when first asked for
            header.get(name)
    return header, syntax


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
    _decoded(path, 0)
    try:
        _decoded(path, count - 1)
    except FileError as error:
        low, high = 0, count - 1
        while high - low > 1:
            middle = (low + high) // 2
            try:
                _decoded(path, middle)
                low = middle
            except FileError:
                high = middle
        raise FileError(f"{path}: ends early: {low + 1} of {count} frames") from error


def _require_grey(path: Path, header: Any) -> int:
    """Refuse what is no sequence of grey images of eight bits; returns the number of frames."""
    if (modality := _text(header, "Modality")) != "US":
        raise InvalidInputError(f"{path}: Modality: expected US, got {modality or 'none'}")
    count = _whole(path, header, "NumberOfFrames", 1)
    if count < 2:
        raise InvalidInputError(f"{path}: NumberOfFrames: expected several frames, got a single image")
    samples = _whole(path, header, "SamplesPerPixel", 1)
    kind = _text(header, "PhotometricInterpretation")
    colours = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
    greys = ("MONOCHROME1", "MONOCHROME2") if samples == 1 else colours
    if samples not in (1, 3) or kind not in greys:
        raise InvalidInputError(
            f"{path}: PhotometricInterpretation: expected {' or '.join(greys)}, got {kind or 'none'}"
        )
    for name, expected in (("BitsAllocated", 8), ("BitsStored", 8), ("PixelRepresentation", 0)):
        if (got := _whole(path, header, name, expected)) != expected:
            raise InvalidInputError(f"{path}: {name}: expected {expected}, got {got}")
    if not _whole(path, header, "Rows", 0) * _whole(path, header, "Columns", 0):
        raise InvalidInputError(f"{path}: expected an image, got no columns or no rows")
    return count


def _place(path: Path, header: Any) -> tuple[_Region, dict[str, Value], list[Row]]:
    """The part of the image to take, the size of its pixels, and what is to be said of it."""
    rows, columns = int(header.Rows), int(header.Columns)
    with _reading(str(path)):
        items = header.get("SequenceOfUltrasoundRegions") or ()
        regions = [_region(f"{path}: SequenceOfUltrasoundRegions[{i}]", item) for i, item in enumerate(items)]
    if not regions:
        return _without_regions(path, header, columns, rows)
    tissue = [one for one in regions if (one.spatial, one.data) == (1, 1)]
    if len(tissue) != 1:
        listed = "; ".join(map(str, regions))
        raise InvalidInputError(f"{path}: expected one region of 2-D tissue, got {len(tissue)} of {listed}")
    one = tissue[0]
    if not (0 <= one.left < one.right < columns and 0 <= one.top < one.bottom < rows):
        raise InvalidInputError(f"{path}: expected a region within {columns} x {rows} pixels, got {one}")
    if one.units != (_UNIT_CM, _UNIT_CM):
        raise InvalidInputError(
            f"{path}: PhysicalUnitsXDirection, PhysicalUnitsYDirection: expected 3 and 3 (cm), got "
            f"{one.units}: a polar image has to be scan-converted first"
        )
    x_mm, y_mm = (10.0 * abs(delta) for delta in one.delta_cm)
    if not min(x_mm, y_mm) > 0:
        raise InvalidInputError(
            f"{path}: PhysicalDeltaX, PhysicalDeltaY: expected other than 0, got {one.delta_cm}"
        )
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
    notes: list[Row] = [("region read", str(one), "")]
    notes += [("region left out", str(other), "") for other in regions if other is not one]
    if one.delta_cm[0] < 0:
        notes.append(("columns", "run against the file's x (PhysicalDeltaX below 0): left as shown", ""))
    if one.delta_cm[1] < 0:
        notes.append(("rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", ""))
    return one, values, notes


def _without_regions(
    path: Path, header: Any, columns: int, rows: int
) -> tuple[_Region, dict[str, Value], list[Row]]:
    with _reading(str(path)):
        spacing = [float(value) for value in header.get("PixelSpacing") or ()]
    values = {}
    if len(spacing) == 2 and min(spacing) > 0 and np.isfinite(spacing).all():
        values = {
            "row_spacing_mm": Value(spacing[0], "PixelSpacing"),
            "column_pitch_mm": Value(spacing[1], "PixelSpacing"),
        }
    words = "the whole image, taken for Cartesian tissue: the file names none"
    return _Region(1, 1, 0, 0, columns - 1, rows - 1), values, [("region read", words, "")]


def _region(where: str, item: Any) -> _Region:
    def number(name: str) -> float:
        try:
            value = float(item.get(name))
        except (TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            got = printable(str(item.get(name)))
            raise InvalidInputError(f"{where}: {name}: expected a number, got {got}")
        return value

    spatial, data = int(number("RegionSpatialFormat")), int(number("RegionDataType"))
    corners = ("MinX0", "MinY0", "MaxX1", "MaxY1")
    left, top, right, bottom = (int(number(f"RegionLocation{name}")) for name in corners)
    units = int(number("PhysicalUnitsXDirection")), int(number("PhysicalUnitsYDirection"))
    if spatial != 1:
        return _Region(spatial, data, left, top, right, bottom, units)
    names = ("ReferencePixelY0", "ReferencePixelPhysicalValueY")
    has_reference = all(item.get(name) is not None for name in names)
    reference = (number(names[0]), number(names[1])) if has_reference else None
    delta = number("PhysicalDeltaX"), number("PhysicalDeltaY")
    return _Region(spatial, data, left, top, right, bottom, units, delta, reference)


def _clock(header: Any, count: int) -> tuple[FloatArray | None, Value, list[str]]:
    """Times of the frames where each has its own, else their rate; and what contradicts."""
    with _reading("frame times"):
        vector = header.get("FrameTimeVector")
        steps = np.atleast_1d(np.asarray([] if vector is None else vector, dtype=float))
        interval = header.get("FrameTime")
        rates = {
            "FrameTime": 1e3 / float(interval) if interval else 0.0,
            "CineRate": float(header.get("CineRate") or 0.0),
            "RecommendedDisplayFrameRate, which is for display": float(
                header.get("RecommendedDisplayFrameRate") or 0
            ),
        }
    said = [(name, rate) for name, rate in rates.items() if np.isfinite(rate) and rate > 0]
    rate = Value()
    if said:
        others = [f"{name} says {other:.4g}" for name, other in said[1:2] if differs(said[0][1], other)]
        rate = Value(said[0][1], ", ".join([said[0][0], *others]))
    if not steps.size:
        return None, rate, []
    steps = steps if steps.size != count - 1 else np.concatenate([[0.0], steps])
    if steps.size != count or not (steps[1:] >= 0).all():
        words = (
            f"FrameTimeVector: {steps.size} steps for {count} frames, not all of them 0 or above: not used"
        )
        return None, rate, [words]
    return np.cumsum(np.concatenate([[0.0], steps[1:]])) / 1e3, rate, []


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


def _facts(header: Any, syntax: Any) -> list[Row]:
    names = {
        "scanner": ("Manufacturer", "ManufacturerModelName"),
        "transducer": ("TransducerType", "TransducerData"),
    }
    rows: list[Row] = []
    for words, elements in names.items():
        if text := " ".join(filter(None, (_text(header, element) for element in elements))):
            rows.append((words, text, ""))
    rows.append(("transfer syntax", printable(str(syntax.name)), ""))
    if _text(header, "LossyImageCompression") == "01":
        rows.append(("pixels", "packed with loss, which smooths speckle", ""))
    return rows


def _text(header: Any, name: str) -> str:
    """Words of an element, as they may be shown; none where there is no such element."""
    value = header.get(name)
    if value is None:
        return ""
    words = value if isinstance(value, list | tuple) or type(value).__name__ == "MultiValue" else [value]
    text = " ".join(printable(" ".join(str(word).split())) for word in words).strip()
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _whole(path: Path, header: Any, name: str, default: int) -> int:
    """Whole number of an element, or `default` where there is no such element."""
    value = header.get(name)
    try:
        return default if value is None else int(value)
    except (TypeError, ValueError):
        raise InvalidInputError(
            f"{path}: {name}: expected a whole number, got {printable(str(value))}"
        ) from None


READER = Reader(FORMAT, _claims, open_dicom)
