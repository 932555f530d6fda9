"""Raw files of Clarius scanners: a header of five numbers, then each frame's time and samples.

Header: five uint32 (id, frames, lines, samples of a line, bytes of a sample); then, by frame, a uint64 time
in nanoseconds and its samples, line by line; all little-endian [1]_.

References
----------
.. [1] clariusdev/research, "Raw Data Format" (docs/raw-data-format.md), ".raw binary layout".
"""

from __future__ import annotations

import operator
import struct
import threading
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.io.clarius.lzop import Unpacker
from speckle3d.io.clarius.package import Member
from speckle3d.io.hdf5 import reading

HEADER = struct.Struct("<5I")
_TIME_BYTES = 8
_MOST_FRAMES = 2**20
"""Ten hours at 30 frames/s; the scanner's memory holds seconds."""

SAMPLES: dict[str, tuple[np.dtype[Any], int, np.dtype[Any]]] = {
    "RF": (np.dtype("<i2"), 1, np.dtype(np.int16)),
    "IQ": (np.dtype("<i2"), 2, np.dtype(np.complex64)),
    "envelope": (np.dtype("u1"), 1, np.dtype(np.uint8)),
}
"""By kind: type of the numbers in the file, how many make a sample, and type of the frames."""


class Factors(Protocol):
    """Factors of the samples of each frame, or of one for all; an array, or made when they are asked for."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Any: ...


@dataclass(frozen=True)
class RawHeader:
    """What a raw file says of itself."""

    frames: int
    lines: int
    samples: int
    sample_bytes: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame without its time."""
        return self.lines * self.samples * self.sample_bytes

    @property
    def file_bytes(self) -> int:
        """Bytes of the whole file."""
        return HEADER.size + self.frames * (_TIME_BYTES + self.frame_bytes)


class RawFile:
    """A raw file, packed or not: any run of its bytes. It is open only while it is read."""

    def __init__(self, member: Member) -> None:
        self.member = member
        self._unpacker = Unpacker(member) if member.name.endswith(".lzo") else None
        self._lock = threading.Lock()

    @property
    def size(self) -> int:
        """Bytes, unpacked."""
        if self._unpacker is None:
            return self.member.size
        with self._lock:
            return self._unpacker.size

    def read(self, start: int, size: int) -> bytes:
        """Read bytes from `start` on.

        Raises
        ------
        FileError
            If there are fewer, or they are damaged.
        """
        if self._unpacker is not None:
            with self._lock:
                return self._unpacker.read(start, size)
        with reading(self.member.where), open_regular(self.member.path) as stream:
            stream.seek(self.member.start + start)
            found = stream.read(max(min(size, self.member.size - start), 0))
        if len(found) != size:
            raise FileError(f"{self.member.where}: expected {start + size} bytes, got {start + len(found)}")
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.member,)


def read_header(raw: RawFile) -> RawHeader:
    """Read the header and check it against the file's length.

    Raises
    ------
    FileError
        If the file is shorter or longer than the header says.
    InvalidInputError
        If the header announces no samples.
    """
    where = raw.member.where
    if raw.size < HEADER.size:
        raise FileError(f"{where}: expected a header of {HEADER.size} bytes, got {raw.size}")
    _, frames, lines, samples, sample_bytes = HEADER.unpack(raw.read(0, HEADER.size))
    header = RawHeader(frames, lines, samples, sample_bytes)
    if 0 in (frames, lines, samples, sample_bytes) or frames > _MOST_FRAMES:
        raise InvalidInputError(
            f"{where}: expected frames, up to {_MOST_FRAMES}, of lines and samples, got {frames} x "
            f"{lines} x {samples} of {sample_bytes} bytes"
        )
    if raw.size != header.file_bytes:
        raise FileError(
            f"{where}: expected {header.file_bytes} bytes for {frames} frames of {lines} lines of {samples} "
            f"samples of {sample_bytes} bytes, got {raw.size}"
        )
    return header


def read_times_ns(raw: RawFile, header: RawHeader) -> npt.NDArray[np.int64]:
    """Read the time of every frame, shape (frame,), nanoseconds of the scanner's clock.

    Raises
    ------
    InvalidInputError
        If they do not rise.
    """
    step = _TIME_BYTES + header.frame_bytes
    read = (raw.read(HEADER.size + i * step, _TIME_BYTES) for i in range(header.frames))
    times = np.frombuffer(b"".join(read), dtype="<u8")
    bad = np.flatnonzero(times[1:] <= times[:-1])
    if bad.size or times[-1] > np.iinfo(np.int64).max:
        i = int(bad[0]) + 1 if bad.size else len(times) - 1
        raise InvalidInputError(
            f"{raw.member.where}: frame {i}: expected a time after {times[i - 1]} ns, got {times[i]} ns"
        )
    return times.astype(np.int64)


class RawFrames:
    """Frames of a raw file, read one at a time; shape (frame, vector, sample).

    Attributes
    ----------
    stored_dtype : dtype
        Of the numbers in the file: int16 for RF and for the pairs of I/Q, uint8 for envelopes; that of the
        frames where samples are multiplied by factors.

    Parameters
    ----------
    lines, samples : slice
        Kept.
    factors : Factors, optional
        What the samples kept are multiplied by; complex or real for I/Q, else real.
    """

    def __init__(
        self,
        raw: RawFile,
        header: RawHeader,
        kind: str,
        lines: slice,
        samples: slice,
        factors: Factors | None = None,
    ) -> None:
        self.raw, self.header, self.kind = raw, header, kind
        self.lines, self.samples, self.factors = lines, samples, factors
        self.stored_dtype, self._parts, self.dtype = SAMPLES[kind]
        if factors is not None:
            self.dtype = np.dtype(np.complex64 if self._parts == 2 else np.float32)
            self.stored_dtype = self.dtype

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        kept = (len(range(self.header.lines)[self.lines]), len(range(self.header.samples)[self.samples]))
        return self.header.frames, *kept

    def __len__(self) -> int:
        return self.header.frames

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        i %= len(self)
        values = self.whole(i)[self.lines, self.samples]
        if self._parts == 2:
            frame: npt.NDArray[Any] = values.astype(np.float32).view(np.complex64)[..., 0]
        else:
            frame = np.ascontiguousarray(values, dtype=SAMPLES[self.kind][2])
        if self.factors is None:
            return frame
        multiplied: npt.NDArray[Any] = frame * self.factors[i % len(self.factors)]
        return multiplied.astype(self.dtype)

    def whole(self, i: int) -> npt.NDArray[Any]:
        """Read a frame as it is in the file, shape (line, sample) or (line, sample, 2)."""
        header = self.header
        start = HEADER.size + i * (_TIME_BYTES + header.frame_bytes) + _TIME_BYTES
        flat = np.frombuffer(self.raw.read(start, header.frame_bytes), dtype=SAMPLES[self.kind][0])
        shape = (header.lines, header.samples)
        whole: npt.NDArray[Any] = flat.reshape(shape if self._parts == 1 else (*shape, 2))
        return whole

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.raw, self.header, self.kind, self.lines, self.samples, self.factors)
