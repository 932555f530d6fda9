"""Multi-frame B-mode in DICOM files, read by pydicom (DICOM PS3.3, C.8.5.5, C.8.5.6, C.7.6.5, C.7.6.6).

Where the file describes its regions (Sequence of Ultrasound Regions), the image is cropped to the region of
2-D tissue, whose Physical Delta X and Y give the size of a pixel: both in cm, so that the image is
Cartesian, a sector with black corners too. Without regions, Pixel Spacing gives it. Elements that name a
patient are never loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import open_regular, plausible_bytes
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Sweep
from speckle3d.io.formats.dicom_elements import read_header, reading_dicom, text_of, whole_of
from speckle3d.io.formats.recordings import Recording
from speckle3d.io.found import Found, differs
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.lazy import LazyFrames, OpenFrames, Unpack
from speckle3d.io.readers import Reader, Row

FORMAT = "DICOM"

_MARK, _MARK_BYTE = b"DICM", 128
_MOST_TIMES_PACKED = 256
"""As of image sequences: what is empty packs well."""

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


@dataclass(frozen=True)
class _Region:
    """A region of the image: its kind, its place in pixels, last ones included, and what a pixel measures."""

    spatial: int
    data: int
    left: int
    top: int
    right: int
    bottom: int
    units: tuple[int, int]
    delta_cm: tuple[float, float]
    reference_y: tuple[float, float] | None

    def __str__(self) -> str:
        kind = f"{_SPATIAL.get(self.spatial, self.spatial)} {_DATA.get(self.data, self.data)}"
        return f"{kind} (columns {self.left} to {self.right}, rows {self.top} to {self.bottom})"


class DicomFrames(LazyFrames):
    """Grey frames of a region, decoded one at a time."""

    def __init__(self, path: Path, count: int, region: _Region, inverted: bool, spread: int) -> None:
        size = region.right - region.left + 1, region.bottom - region.top + 1
        super().__init__(path, (count, *size), np.uint8)
        self.region, self.inverted, self.spread = region, inverted, spread

    def _opened(self) -> OpenFrames:
        return _OpenImages(self)


class _OpenImages:
    def __init__(self, frames: DicomFrames) -> None:
        self._frames = frames

    def read(self, i: int) -> Unpack:
        return partial(self._frame, i)

    def _frame(self, i: int) -> npt.NDArray[Any]:
        from pydicom.pixels.utils import pixel_array

        path, region = self._frames.path, self._frames.region
        with reading_dicom(f"{path}: frame {i}"), open_regular(path) as stream:
            image = np.asarray(pixel_array(stream, index=i))
        image = image[region.top : region.bottom + 1, region.left : region.right + 1]
        grey = _grey(image, self._frames.spread).T
        if self._frames.inverted:
            grey = 255 - grey
        return grey[:, ::-1] if region.delta_cm[1] < 0 else grey

    def close(self) -> None:
        """Nothing stays open between frames."""


def read_dicom(path: Path, settings: ImportSettings | None = None) -> Sweep:
    """Read grey images of eight bits; they stay in the file until they are asked for.

    Raises
    ------
    FileError
        If the file cannot be read, or what unpacks it is not installed.
    InvalidInputError
        Naming what is recorded, if it is no such image.
    MissingSettingsError
        Naming all that the file does not say: always the dynamic range.
    """
    given = settings or ImportSettings()
    return _recording(path, given).sweep(given)


def _claims(_: Path, start: bytes) -> bool:
    return start[_MARK_BYTE : _MARK_BYTE + len(_MARK)] == _MARK


def _describe(path: Path, settings: ImportSettings) -> list[Row]:
    try:
        return _recording(path, settings).rows(settings)
    except InvalidInputError:
        # Why there is no sweep is told beside these rows.
        try:
            with open_regular(path) as stream:
                return list(_notes(*read_header(path, stream)))
        except InvalidInputError:
            return [("elements", "not read", "")]


def _recording(path: Path, settings: ImportSettings) -> Recording:
    with open_regular(path) as stream:
        header, syntax = read_header(path, stream)
        _require_decoder(path, syntax)
        size = stream.seek(0, 2)
    count = _require_grey(path, header, syntax, size)
    region, found, notes = _place(path, header)
    times, rate = _clock(path, header, count, settings.frame_rate_hz is not None)
    lossy = text_of(header, "LossyImageCompression") == "01" or "YBR" in text_of(
        header, "PhotometricInterpretation"
    )
    inverted = text_of(header, "PhotometricInterpretation") == "MONOCHROME1"
    frames = DicomFrames(path, count, region, inverted, _LOSSY_SPREAD if lossy else 0)
    with naming(str(path)):
        _ = frames[count // 2]  # colour, and what cannot be unpacked, is told before a reconstruction begins
    frames.close()
    return Recording(
        path, frames, {**found, "frame_rate_hz": rate}, time_s=times, notes=(*_notes(header, syntax), *notes)
    )


def _require_decoder(path: Path, syntax: Any) -> None:
    from pydicom.pixels.decoders.base import get_decoder

    with reading_dicom(str(path)):
        name = printable(str(syntax.name))
        try:
            decoder = get_decoder(syntax)
        except NotImplementedError:
            raise InvalidInputError(f"{path}: expected pixels that pydicom unpacks, got {name}") from None
    if not decoder.is_available:
        needs = ", or ".join(printable(each) for each in decoder.missing_dependencies)
        raise InvalidInputError(f"{path}: {name}: expected a package that unpacks it: {needs}")


def _require_grey(path: Path, header: Any, syntax: Any, file_bytes: int) -> int:
    """Refuse what is no sequence of grey images of eight bits; returns the number of frames."""
    if (modality := text_of(header, "Modality")) != "US":
        raise InvalidInputError(f"{path}: Modality: expected US, got {modality or 'none'}")
    count = whole_of(path, header, "NumberOfFrames", 1)
    if count < 2:
        raise InvalidInputError(f"{path}: NumberOfFrames: expected several frames, got a single image")
    rows, columns = (whole_of(path, header, name, 0) for name in ("Rows", "Columns"))
    samples = whole_of(path, header, "SamplesPerPixel", 1)
    kind = text_of(header, "PhotometricInterpretation")
    greys = (
        ("MONOCHROME1", "MONOCHROME2")
        if samples == 1
        else ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
    )
    if samples not in (1, 3) or kind not in greys:
        raise InvalidInputError(
            f"{path}: PhotometricInterpretation: expected {' or '.join(greys)}, got {kind or 'none'}"
        )
    for name, expected in (("BitsAllocated", 8), ("BitsStored", 8), ("PixelRepresentation", 0)):
        if (got := whole_of(path, header, name, expected)) != expected:
            raise InvalidInputError(f"{path}: {name}: expected {expected}, got {got}")
    frame_bytes = rows * columns * samples
    if not frame_bytes:
        raise InvalidInputError(f"{path}: expected an image, got {columns} columns and {rows} rows")
    # YBR_FULL_422 leaves out a third of its bytes.
    needed = 0 if syntax.is_compressed else count * frame_bytes * 2 // 3
    most = plausible_bytes(file_bytes, _MOST_TIMES_PACKED) if syntax.is_compressed else file_bytes
    if max(needed, count) > file_bytes or frame_bytes > most:
        asked = f"{count} frames of {columns} x {rows} x {samples} bytes"
        raise FileError(f"{path}: expected {asked}, got {file_bytes} bytes")
    return count


def _place(path: Path, header: Any) -> tuple[_Region, dict[str, Found], list[Row]]:
    """The part of the image to take, the size of its pixels, and what is to be said of it."""
    rows, columns = int(header.Rows), int(header.Columns)
    with reading_dicom(str(path)):
        regions = [
            _region(path, i, item) for i, item in enumerate(header.get("SequenceOfUltrasoundRegions") or ())
        ]
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
    if not (np.isfinite([x_mm, y_mm]).all() and x_mm > 0 and y_mm > 0):
        raise InvalidInputError(
            f"{path}: PhysicalDeltaX, PhysicalDeltaY: expected other than 0, got {one.delta_cm}"
        )
    found = {
        "column_pitch_mm": Found(x_mm, "PhysicalDeltaX"),
        "row_spacing_mm": Found(y_mm, "PhysicalDeltaY"),
    }
    if one.reference_y is not None:
        found["first_sample_depth_mm"] = Found(
            _first_depth_mm(one), "ReferencePixelY0 and its physical value"
        )
    notes: list[Row] = [("region read", str(one), "")]
    notes += [("region left out", str(other), "") for other in regions if other is not one]
    if one.delta_cm[0] < 0:
        notes.append(
            ("columns", "run against the file's x (PhysicalDeltaX below 0): left as they are shown", "")
        )
    if one.delta_cm[1] < 0:
        notes.append(("rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", ""))
    return one, found, notes


def _without_regions(
    path: Path, header: Any, columns: int, rows: int
) -> tuple[_Region, dict[str, Found], list[Row]]:
    whole = _Region(1, 1, 0, 0, columns - 1, rows - 1, (_UNIT_CM, _UNIT_CM), (1.0, 1.0), None)
    found = {}
    with reading_dicom(str(path)):
        spacing = [float(value) for value in header.get("PixelSpacing") or ()]
    if len(spacing) == 2 and min(spacing) > 0 and np.isfinite(spacing).all():
        found = {
            "row_spacing_mm": Found(spacing[0], "PixelSpacing"),
            "column_pitch_mm": Found(spacing[1], "PixelSpacing"),
        }
    return (
        whole,
        found,
        [("region read", "the whole image, taken for Cartesian tissue: the file names none", "")],
    )


def _first_depth_mm(region: _Region) -> float:
    """Depth of the first row taken, which is the region's last where y falls."""
    assert region.reference_y is not None
    pixel, value_cm = region.reference_y
    row = region.bottom - region.top if region.delta_cm[1] < 0 else 0
    return 10.0 * (value_cm + (row - pixel) * region.delta_cm[1])


def _region(path: Path, index: int, item: Any) -> _Region:
    where = f"{path}: SequenceOfUltrasoundRegions[{index}]"

    def number(name: str) -> float:
        value = item.get(name)
        try:
            made = float(value)
        except (TypeError, ValueError):
            made = np.nan
        if not np.isfinite(made):
            raise InvalidInputError(f"{where}: {name}: expected a number, got {printable(str(value))}")
        return made

    box = [int(number(f"RegionLocation{name}")) for name in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
    is_image = int(number("RegionSpatialFormat")) == 1
    reference = None
    if (
        is_image
        and item.get("ReferencePixelY0") is not None
        and item.get("ReferencePixelPhysicalValueY") is not None
    ):
        reference = number("ReferencePixelY0"), number("ReferencePixelPhysicalValueY")
    left, top, right, bottom = box
    return _Region(
        spatial=int(number("RegionSpatialFormat")),
        data=int(number("RegionDataType")),
        left=left,
        top=top,
        right=right,
        bottom=bottom,
        units=(int(number("PhysicalUnitsXDirection")), int(number("PhysicalUnitsYDirection"))),
        delta_cm=(number("PhysicalDeltaX"), number("PhysicalDeltaY")) if is_image else (1.0, 1.0),
        reference_y=reference,
    )


def _clock(
    path: Path, header: Any, count: int, rate_is_given: bool
) -> tuple[npt.NDArray[np.float64] | None, Found]:
    """Times of the frames where each has its own and no rate is given, else their rate."""
    with reading_dicom(str(path)):
        vector = header.get("FrameTimeVector")
        steps = np.atleast_1d(np.asarray([] if vector is None else vector, dtype=float))
        frame_time = header.get("FrameTime")
        rates = [
            ("FrameTime", 1e3 / float(frame_time) if frame_time else 0.0),
            ("CineRate", float(header.get("CineRate") or 0.0)),
            (
                "RecommendedDisplayFrameRate, which is for display",
                float(header.get("RecommendedDisplayFrameRate") or 0),
            ),
        ]
    if steps.size and not rate_is_given:
        if steps.size != count or not np.isfinite(steps).all() or not (steps[1:] > 0).all():
            raise InvalidInputError(
                f"{path}: FrameTimeVector: expected {count} times above 0 after the first, got {steps.size} "
                "(--frame-rate-hz replaces them)"
            )
        return np.cumsum(np.concatenate([[0.0], steps[1:]])) / 1e3, Found()
    said = [(name, rate) for name, rate in rates if np.isfinite(rate) and rate > 0]
    if not said:
        return None, Found()
    name, rate = said[0]
    others = [f"{other} says {each:.4g}" for other, each in said[1:2] if differs(rate, each)]
    return None, Found(rate, ", ".join([name, *others]))


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
    grey: npt.NDArray[np.uint8] = np.rint(image.mean(axis=2)).astype(np.uint8)
    return grey


def _notes(header: Any, syntax: Any) -> tuple[Row, ...]:
    named = {
        "scanner": ("Manufacturer", "ManufacturerModelName"),
        "transducer": ("TransducerType", "TransducerData"),
    }
    rows: list[Row] = []
    for spoken, names in named.items():
        if text := " ".join(filter(None, (text_of(header, name) for name in names))):
            rows.append((spoken, text, ""))
    rows.append(("transfer syntax", printable(str(syntax.name)), ""))
    if text_of(header, "LossyImageCompression") == "01":
        rows.append(("pixels", "packed with loss, which smooths speckle", ""))
    return tuple(rows)


def _contradictions(path: Path, settings: ImportSettings) -> list[str]:
    return _recording(path, settings).contradictions(settings)


READER = Reader(FORMAT, _claims, read_dicom, _describe, notes=_contradictions)
