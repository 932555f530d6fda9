"""Deflate by ISA-L, four times as fast as zlib, or by zlib where ISA-L has no wheel."""

from __future__ import annotations

import zlib
from typing import Any

_library: Any = zlib
try:
    from isal import isal_zlib

    _library = isal_zlib
except ImportError:
    pass

ZLIB, GZIP, EITHER = 15, 31, 47
"""Windows of deflate, and by them what is around it; either is told when unpacking."""


def packer(window: int) -> Any:
    """Packer of level 1: at higher levels speckle hardly shrinks further, and takes several times as long."""
    return _library.compressobj(1, zlib.DEFLATED, window)


def unpacker() -> Any:
    """Unpacker of zlib's or gzip's stream."""
    return _library.decompressobj(EITHER)
