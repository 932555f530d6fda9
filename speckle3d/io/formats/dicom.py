"""Multi-frame B-mode in DICOM files, read by pydicom (DICOM PS3.3, C.8.5.5, C.8.5.6, C.7.6.5, C.7.6.6).

Where the file describes its regions (Sequence of Ultrasound Regions), the image is cropped to the region of
2-D tissue, whose Physical Delta X and Y give the size of a pixel: both in cm, so that the image is
Cartesian, a sector with black corners too. Without regions, Pixel Spacing gives it. Elements that name a
patient are never loaded.
"""

from __future__ import annotations

import warnings
from bisect import bisect
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
from speckle3d.io.hdf5 import reading
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
_RATES = ("FrameTime", "CineRate", "RecommendedDisplayFrameRate")
_EIGHT_BITS = {"BitsAllocated": 8, "BitsStored": 8, "PixelRepresentation": 0}
_GREYS = {
    1: ("MONOCHROME1", "MONOCHROME2"),
    3: ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT"),
}
"""Photometric interpretations that are read, by samples a pixel."""
_TAGS = (
    "SOPClassUID", "Modality", "Manufacturer", "ManufacturerModelName", "TransducerData", "TransducerType",
    "NumberOfFrames", "FrameTimeVector", *_RATES, "SamplesPerPixel", "PhotometricInterpretation", "Rows",
    "Columns", "PlanarConfiguration", *_EIGHT_BITS, "PixelSpacing", "LossyImageCompression",
    "SequenceOfUltrasoundRegions",
)  # fmt: skip
"""All that is loaded."""


@dataclass(frozen=True)
class DicomFile:
    """Decodes grey frames of a region, one at a time.

    Attributes
    ----------
    rows, columns : slice
        Of the region.
    inverted : bool
        Whether black is the highest level.
    spread : int
        Levels by which the colours of a grey pixel may differ.
    """

    path: Path
    rows: slice
    columns: slice
    inverted: bool
    spread: int

    def __call__(self) -> ReadFrame:
        """Open nothing: each frame is read from the file anew."""
        return self.read

    def read(self, i: int) -> npt.NDArray[Any]:
        """Decode frame i, shape (column, row)."""
        grey = _grey(_decoded(self.path, i)[self.rows, self.columns], self.spread).T
        return 255 - grey if self.inverted else grey


def open_dicom(path: Path, settings: ImportSettings) -> Recording:
    """Read grey images of eight bits; they stay in the file until they are asked for."""
    header, rows = _header(path)
    return Recording.of(path, settings, rows, lambda: _recording(path, settings, header, rows))


def _recording(path: Path, settings: ImportSettings, header: Any, rows: list[Row]) -> Recording:
    count = _require_grey(path, header)
    part, values = _place(path, header, rows)
    kind = _text(header, "PhotometricInterpretation")
    is_lossy = _text(header, "LossyImageCompression") == "01" or "YBR" in kind
    source = DicomFile(path, *part, kind == "MONOCHROME1", _LOSSY_SPREAD if is_lossy else 0)
    _require_all_frames(path, count)
    shape = (count, *source.read(count // 2).shape)  # colour is told before a reconstruction begins
    times, values["frame_rate_hz"], remarks = _clock(header, count)
    frames = FileFrames(path, source, shape, np.uint8)
    return Recording(path, settings, frames, values, time_s=times, remarks=remarks)


def _header(path: Path) -> tuple[Any, list[Row]]:
    """Elements beside the pixels, and what they say of the machine."""
    pydicom = extra_module("pydicom", "dicom", f"{path}: DICOM")
    with _reading(str(path)), open_regular(path) as stream:
        syntax = pydicom.filereader.read_file_meta_info(path)["TransferSyntaxUID"].value.name
        header = pydicom.dcmread(stream, stop_before_pixels=True, specific_tags=list(_TAGS))
        for name in _TAGS:  # elements are read from their bytes when first asked for
            header.get(name)
    scanner, transducer = (
        f"{_text(header, first)} {_text(header, second)}".strip()
        for first, second in (("Manufacturer", "ManufacturerModelName"), ("TransducerType", "TransducerData"))
    )
    rows = [row for row in (("scanner", scanner, ""), ("transducer", transducer, "")) if row[1]]
    rows.append(("transfer syntax", printable(syntax), ""))
    if _text(header, "LossyImageCompression") == "01":
        rows.append(("pixels", "packed with loss, which smooths speckle", ""))
    return header, rows


@contextmanager
def _reading(where: str) -> Iterator[None]:
    """Turn what pydicom raises on damaged files into one line, and keep its warnings to itself."""
    import pydicom.config

    with reading(where, Exception), warnings.catch_warnings(), pydicom.config.disable_value_validation():
        warnings.simplefilter("ignore")
        yield


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
    greys = _GREYS.get(int(_number(path, header, "SamplesPerPixel", 1)), ())
    for name, expected in (("Modality", ("US",)), ("PhotometricInterpretation", greys)):
        if (kind := _text(header, name)) not in expected:
            raise InvalidInputError(f"{path}: {name}: expected {' or '.join(expected)}, got {kind or 'none'}")
    for name, bits in _EIGHT_BITS.items():
        if (got := _number(path, header, name, bits)) != bits:
            raise InvalidInputError(f"{path}: {name}: expected {bits}, got {got:g}")
    count = int(_number(path, header, "NumberOfFrames", 1))
    if count < 2:
        raise InvalidInputError(f"{path}: NumberOfFrames: expected several frames, got a single image")
    return count


def _place(path: Path, header: Any, rows: list[Row]) -> tuple[tuple[slice, slice], dict[str, Value]]:
    """Rows and columns of the image to take, and the size of its pixels; facts tell of it."""
    regions = header.get("SequenceOfUltrasoundRegions") or ()
    if not regions:
        rows.append(("region read", "the whole image, taken for Cartesian tissue: the file names none", ""))
        spacing = [float(value) for value in header.get("PixelSpacing") or ()]
        is_sized = len(spacing) == 2 and min(spacing) > 0 and np.isfinite(spacing).all()
        names = ("row_spacing_mm", "column_pitch_mm") if is_sized else ()
        values = {name: Value(mm, "PixelSpacing") for name, mm in zip(names, spacing, strict=False)}
        return (slice(None), slice(None)), values
    descriptions = [_region_words(path, region) for region in regions]
    tissue = [i for i, region in enumerate(regions) if _kind(path, region) == _TISSUE]
    if len(tissue) != 1:
        listed = "; ".join(descriptions)
        raise InvalidInputError(f"{path}: expected one region of 2-D tissue, got {len(tissue)} of {listed}")
    (i,) = tissue
    left, top, right, bottom = _corners(path, regions[i])
    width, height = (int(_number(path, header, name)) for name in ("Columns", "Rows"))
    if not (0 <= left < right < width and 0 <= top < bottom < height):
        raise InvalidInputError(
            f"{path}: expected a region within {width} x {height} pixels, got {descriptions[i]}"
        )
    units, (x_cm, y_cm) = (
        tuple(_number(path, regions[i], name.format(axis)) for axis in "XY")
        for name in ("PhysicalUnits{}Direction", "PhysicalDelta{}")
    )
    if units != _CM or not x_cm * y_cm:
        raise InvalidInputError(
            f"{path}: PhysicalUnits and PhysicalDelta of X and Y: expected units 3 and 3 (cm) and steps "
            f"other than 0, got {units} and {(x_cm, y_cm)}: a polar image has to be scan-converted first"
        )
    values = {
        "column_pitch_mm": Value(10.0 * abs(x_cm), "PhysicalDeltaX"),
        "row_spacing_mm": Value(10.0 * abs(y_cm), "PhysicalDeltaY"),
    }
    reference = ("ReferencePixelY0", "ReferencePixelPhysicalValueY")
    if None not in map(regions[i].get, reference):
        pixel, value_cm = (_number(path, regions[i], name) for name in reference)
        # The first row taken is the region's last where y falls.
        depth_mm = 10.0 * (value_cm + ((bottom - top if y_cm < 0 else 0) - pixel) * y_cm)
        values["first_sample_depth_mm"] = Value(depth_mm, "ReferencePixelY0 and its physical value")
    rows.append(("region read", descriptions[i], ""))
    rows += [("region left out", other, "") for k, other in enumerate(descriptions) if k != i]
    if x_cm < 0:
        rows.append(("columns", "run against the file's x (PhysicalDeltaX below 0): left as shown", ""))
    if y_cm < 0:
        rows.append(("rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", ""))
        return (slice(bottom, top - 1 if top else None, -1), slice(left, right + 1)), values
    return (slice(top, bottom + 1), slice(left, right + 1)), values


def _corners(path: Path, region: Any) -> list[int]:
    """First column and row, last column and row."""
    names = ("MinX0", "MinY0", "MaxX1", "MaxY1")
    return [int(_number(path, region, f"RegionLocation{name}")) for name in names]


def _kind(path: Path, region: Any) -> tuple[int, int]:
    spatial, data = (_number(path, region, name) for name in ("RegionSpatialFormat", "RegionDataType"))
    return int(spatial), int(data)


def _region_words(path: Path, region: Any) -> str:
    (left, top, right, bottom), kind = _corners(path, region), _kind(path, region)
    what = "2-D tissue" if kind == _TISSUE else "RegionSpatialFormat {}, RegionDataType {}".format(*kind)
    return f"{what} (columns {left} to {right}, rows {top} to {bottom})"


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
    steps = steps[1:] if steps.size == count else steps
    if steps.size != count - 1 or not np.isfinite(steps).all():
        words = f"FrameTimeVector: {steps.size} steps for {count} frames, or some that are no numbers"
        return None, rate, (f"{words}: not used",)
    return np.cumsum([0.0, *steps]) / 1e3, rate, ()


def _grey(image: npt.NDArray[Any], spread: int) -> npt.NDArray[np.uint8]:
    """Grey levels of an image, refused where a pixel has a colour."""
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
    words = [value] if value is None or isinstance(value, str) else np.ravel(value)
    return printable(" ".join(str(word) for word in words if word is not None)).strip()


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
