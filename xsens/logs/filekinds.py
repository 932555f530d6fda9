"""Files that are no log of the sensor, told by how they begin, so that a mix-up can be named."""

from __future__ import annotations

_BEGINNINGS = (
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"PK\x03\x04", "a ZIP archive (or a spreadsheet)"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"\x89PNG\r\n\x1a\n", "a PNG image"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"%PDF-", "a PDF document"),
    (b"PAR1", "a Parquet file"),
    (b"ObjectType = ", "a MetaImage header"),
    (b"NRRD000", "an NRRD image"),
)


def other_kind(data: bytes) -> str | None:
    """What a file seems to be, in words, if it is clearly no log; None if it may be one."""
    for beginning, kind in _BEGINNINGS:
        if data.startswith(beginning):
            return kind
    return "nothing but zeros" if not data.strip(b"\0") else None
