"""Elements of DICOM files, read by pydicom: those that are needed, and none that name a patient."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import one_line, reading

_DEFLATED = "1.2.840.10008.1.2.1.99"
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


def read_header(path: Path, stream: BufferedReader) -> tuple[Any, Any]:
    """Elements beside the pixels, and the transfer syntax."""
    try:
        import pydicom
        from pydicom.filereader import read_file_meta_info
    except ImportError as error:
        raise FileError(
            f'{path}: expected pydicom for DICOM, got none: pip install "speckle3d[dicom]"'
        ) from error
    with reading_dicom(str(path)):
        syntax = read_file_meta_info(path).get("TransferSyntaxUID")
        if syntax is None:
            raise InvalidInputError(f"{path}: expected a transfer syntax, got none")
        if syntax == _DEFLATED:
            raise InvalidInputError(f"{path}: expected pixels packed one by one, got {syntax.name}")
        stream.seek(0)
        header = pydicom.dcmread(stream, stop_before_pixels=True, specific_tags=list(_TAGS))
        # Elements are read from their bytes when first asked for.
        for name in _TAGS:
            header.get(name)
    return header, syntax


@contextmanager
def reading_dicom(where: str) -> Iterator[None]:
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


def text_of(header: Any, name: str) -> str:
    """Words of an element, as they may be shown; none where there is no such element."""
    value = header.get(name)
    if value is None:
        return ""
    words = value if isinstance(value, list | tuple) or type(value).__name__ == "MultiValue" else [value]
    text = " ".join(printable(" ".join(str(word).split())) for word in words).strip()
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def whole_of(path: Path, header: Any, name: str, default: int) -> int:
    """Whole number of an element, or `default` where there is no such element."""
    value = header.get(name)
    try:
        return default if value is None else int(value)
    except (TypeError, ValueError):
        raise InvalidInputError(
            f"{path}: {name}: expected a whole number, got {printable(str(value))}"
        ) from None
