"""Multi-frame B-mode in DICOM files, read by pydicom (DICOM PS3.3, C.8.5.5, C.8.5.6, C.7.6.5, C.7.6.6).

Where the file describes its regions (Sequence of Ultrasound Regions), the image is cropped to the region of
2-D tissue, whose Physical Delta X and Y give the size of a pixel: both in cm where the image is Cartesian, a
sector with black corners too; degrees along X where its columns are the lines of a fan, whose array's radius
no element tells. Without regions, Pixel Spacing gives it. Elements that name a patient are never loaded.
"""

import warnings
from bisect import bisect
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.files import open_regular
from speckle3d.core.images import IN_COLOUR, LUMINANCE
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Row, Value, differs

FORMAT = "DICOM"

_MARK, _MARK_BYTE = b"DICM", 128
_FIRST_ELEMENT = b"\2\0\0\0UL"
"""Of files without the preamble that ends in the mark."""
_SUFFIXES = (".dcm", ".dicom")
"""Of files that may lack all that comes before the image's elements."""
_TISSUE, _CM, _POLAR = [1.0, 1.0], [3.0, 3.0], [12.0, 3.0]
"""Region Spatial Format and Data Type of 2-D tissue; Physical Units of X and Y, cm, or degrees and cm."""
_KIND = ("RegionSpatialFormat", "RegionDataType")
_BOX = [f"RegionLocation{end}" for end in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
_MACHINE = ("Manufacturer", "ManufacturerModelName", "TransducerType", "TransducerData")
_RATES = ("FrameTime", "CineRate", "RecommendedDisplayFrameRate")
_EXPECTED = {
    "Modality": ("US",),
    "PhotometricInterpretation": (
        "MONOCHROME1", "MONOCHROME2", "RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT",
    ),
    "BitsAllocated": (8,),
    "PixelRepresentation": (0,),
}  # fmt: skip
_TAGS = (
    *_MACHINE, *_RATES, *_EXPECTED, "NumberOfFrames", "FrameTimeVector", "Rows", "Columns", "PixelSpacing",
    "LossyImageCompression", "SequenceOfUltrasoundRegions",
)  # fmt: skip
"""All that is loaded."""


def _frames(path: Path, part: tuple[slice, slice], invert: bool, syntax: str) -> ReadFrame:
    """Decode grey frames of a region, (column, row), each from the file anew.

    Parameters
    ----------
    part : pair of slice
        Rows and columns of the region.
    invert : bool
        Whether black is the highest level.
    syntax : str
        UID of the transfer syntax, which the file may lack.
    """
    from pydicom.pixels.utils import pixel_array

    def frame(i: int) -> Any:
        with _reading(f"{path}: frame {i}"), open_regular(path) as stream:
            image = np.asarray(pixel_array(stream, index=i, transfer_syntax_uid=syntax))[part]
        if image.ndim == 3:
            image = np.rint(image @ LUMINANCE).astype(np.uint8)
        return 255 - image.T if invert else image.T

    return frame


def open_dicom(path: Path, settings: ImportSettings) -> Facts:
    """Read grey images of eight bits; they stay in the file until they are asked for."""
    pydicom = extra_module("pydicom", "dicom", f"{path}: DICOM")
    from pydicom import uid

    with _reading(str(path)), open_regular(path) as stream:
        header = pydicom.dcmread(stream, stop_before_pixels=True, force=True, specific_tags=list(_TAGS))
        plain = uid.ImplicitVRLittleEndian if header.original_encoding[0] else uid.ExplicitVRLittleEndian
        syntax = str(header.file_meta.get("TransferSyntaxUID", plain))
        list(header.iterall())  # elements are read from their bytes when first asked for
    machine = " ".join(str(header[name].value) for name in _MACHINE if name in header)
    yield "scanner", machine or "not named", ""
    for name, expected in _EXPECTED.items():
        if (value := header.get(name)) not in expected:
            words = " or ".join(map(str, expected))
            raise InvalidInputError(f"{name}: expected {words}, got {value}")
    count = int(header.get("NumberOfFrames") or 1)
    part, values = yield from _place(header)
    if header.get("LossyImageCompression") == "01":
        yield "pixels", "packed with loss, which smooths speckle", ""
    kind = header.PhotometricInterpretation
    source = partial(_frames, path, part, kind == "MONOCHROME1", syntax)
    read = source()

    def is_cut(i: int) -> bool:
        try:
            read(i)
        except FileError:
            return True
        return False

    first = read(0)  # what cannot be decoded at all is told at once
    if is_cut(count - 1):
        whole = bisect(range(count), False, key=is_cut)
        raise FileError(f"{path}: ends early: {whole} of {count} frames")
    times, values["frame_rate_hz"], remarks = _clock(header, count)
    remarks += () if "MONOCHROME" in kind else (IN_COLOUR,)
    frames = FileFrames(path, source, (count, *first.shape), np.uint8)
    return Recording(path, settings, frames, values, time_s=times, remarks=remarks)


@contextmanager
def _reading(where: str) -> Iterator[None]:
    """Turn what pydicom raises on damaged files into one line, and keep its warnings to itself."""
    import pydicom.config

    with reading(where, Exception), warnings.catch_warnings(), pydicom.config.disable_value_validation():
        warnings.simplefilter("ignore")
        yield


def _place(header: Any) -> Generator[Row, None, tuple[tuple[slice, slice], dict[str, Value]]]:
    """Rows and columns of the image to take, and the size of its pixels; facts tell of it."""
    regions = header.get("SequenceOfUltrasoundRegions") or ()
    if not regions:
        yield "region read", "the whole image, taken for Cartesian tissue: the file names none", ""
        sizes = zip(("row_spacing_mm", "column_pitch_mm"), header.get("PixelSpacing") or (), strict=False)
        values = {name: Value(float(mm) or None, "PixelSpacing") for name, mm in sizes}
        return (slice(None), slice(None)), values
    tissue = []
    for candidate in regions:
        kind, box = _numbers(candidate, *_KIND), [int(number) for number in _numbers(candidate, *_BOX)]
        name = f"{_KIND[0]} {kind[0]:g}, {_KIND[1]} {kind[1]:g}"
        place = "columns {0} to {2}, rows {1} to {3}".format(*box)
        yield f"region {'read' if kind == _TISSUE else 'left out'}", f"{name} ({place})", ""
        tissue += [(candidate, box)] if kind == _TISSUE else []
    if len(tissue) != 1:
        raise InvalidInputError(f"expected one region of 2-D tissue, got {len(tissue)} of {len(regions)}")
    region, (left, top, right, bottom) = tissue[0]
    width, height = _numbers(header, "Columns", "Rows")
    right, bottom = min(right, int(width) - 1), min(bottom, int(height) - 1)
    units = _numbers(region, "PhysicalUnitsXDirection", "PhysicalUnitsYDirection")
    x_step, y_cm = _numbers(region, "PhysicalDeltaX", "PhysicalDeltaY")
    if units not in (_CM, _POLAR):
        raise InvalidInputError(
            f"PhysicalUnits of X and Y: expected 3 and 3 (cm), or 12 and 3 (degrees and cm), got {units}"
        )
    values = {"row_spacing_mm": Value(10.0 * abs(y_cm), "PhysicalDeltaY")}
    if units == _CM:
        values["column_pitch_mm"] = Value(10.0 * abs(x_step), "PhysicalDeltaX")
    else:
        angles_deg = sorted(_along(region, "X", x_step, 0, right - left))
        values["line_angles_deg"] = Value(tuple(angles_deg) or None, "ReferencePixelX0 and PhysicalDeltaX")
    # The first row taken is the region's last where y falls.
    for depth_cm in _along(region, "Y", y_cm, bottom - top if y_cm < 0 else 0):
        values["first_sample_depth_mm"] = Value(10.0 * depth_cm, "ReferencePixelY0 and its physical value")
    depths = slice(top, bottom + 1)
    if y_cm < 0:
        yield "rows", "turned over: the file's y falls (PhysicalDeltaY below 0)", ""
        depths = slice(bottom, top - 1 if top else None, -1)
    return (depths, slice(left, right + 1)), values


def _along(region: Any, axis: str, step: float, *pixels: int) -> list[float]:
    """Physical values of pixels along an axis of a region; none where it has no reference pixel."""
    reference = (f"ReferencePixel{axis}0", f"ReferencePixelPhysicalValue{axis}")
    if not all(name in region for name in reference):
        return []
    pixel, value = _numbers(region, *reference)
    return [value + (number - pixel) * step for number in pixels]


def _clock(header: Any, count: int) -> tuple[FloatArray | None, Value, tuple[str, ...]]:
    """Times of the frames where each has its own, else their rate; and what contradicts."""
    with _reading("frame times"):
        steps = np.ravel(np.asarray(header.get("FrameTimeVector") or [], dtype=float))
        numbers = [float(header.get(name) or 0.0) for name in _RATES]
    rates = [
        Value(1e3 / number if name == "FrameTime" else number, name)
        for name, number in zip(_RATES, numbers, strict=True)
        if number > 0
    ]
    rate, *rivals = rates or [Value()]
    if rivals and differs(rate.value, rivals[0].value):
        words = f"{rate.source}, {rivals[0].source} says {rivals[0].value:.4g}"
        rate = Value(rate.value, words)
    steps = steps[int(steps.size == count) :]  # the first of as many as there are frames is 0
    if steps.size == count - 1:
        return np.cumsum([0.0, *steps]) / 1e3, rate, ()
    words = f"FrameTimeVector: {steps.size} steps for {count} frames: not used"
    return None, rate, (words,) if steps.size else ()


def _numbers(item: Any, *names: str) -> list[float]:
    """Read the numbers of several elements."""
    with _reading(", ".join(names)):
        return [float(item[name].value) for name in names]


READER = Reader(
    FORMAT,
    lambda path, start: (
        start[_MARK_BYTE:].startswith(_MARK)
        or start.startswith(_FIRST_ELEMENT)
        or path.suffix.lower() in _SUFFIXES
    ),
    open_dicom,
)
