"""Read logs of the sensor; the kind of a log is told by its content, never by its name."""

from dataclasses import replace
from io import TextIOWrapper

import numpy as np

from speckle3d.core.arrays import ByteArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from xsens.logs.datamessages import legacy_samples, mtdata2_samples
from xsens.logs.parts import Hints, assemble_log
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import parse_text
from xsens.messages.control import MessageId
from xsens.messages.framing import find_frames

_HEAD_BYTES = 1 << 16
_WIDE = (b"\xff\xfe", b"\xfe\xff")
"""First bytes of text whose characters take two bytes."""

_DATA = (MessageId.MT_DATA, MessageId.MT_DATA2)


def read_log(path: PathLike, hints: Hints | None = None) -> ImuLog:
    r"""Read a log: MT9 software ``.bin``, ``.mtb``, raw bytes of a port, or text of any known kind.

    Parameters
    ----------
    path : path
    hints : Hints, optional
        Facts known beside the file.

    Returns
    -------
    ImuLog
        Its notes tell what was skipped, assumed or not compensated.

    Raises
    ------
    FileError
        If the file cannot be read, or is no file.
    InvalidInputError
        If it holds no samples of the sensor, or lacks what is needed to understand them.

    Examples
    --------
    >>> import pathlib, tempfile, xsens
    >>> rows = [f"{time_s},0,0,9.8\n" for time_s in (0.0, 0.01, 0.02, 0.05)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder, "log.csv")
    ...     _ = path.write_text("time_s,acc_x,acc_y,acc_z\n" + "".join(rows))
    ...     log = xsens.read_log(path)
    >>> len(log), log.lost
    (4, 2)
    """
    with open_regular(path) as file:
        head = file.read(_HEAD_BYTES)
        file.seek(0)
        if not head:
            raise InvalidInputError(f"{path}: expected a log of the sensor, got an empty file")
        wide = head.startswith(_WIDE)
        if (wide or 100 * head.count(0) <= len(head)) and not len(find_frames(head)):
            encoding = "utf-16" if wide else "utf-8-sig"
            with TextIOWrapper(file, encoding, errors="replace") as text:
                return parse_text(text, hints, str(path))
        return parse_stream(file.read(), hints, str(path))  # which alone holds the bytes


# -- the sensor's own bytes


def parse_stream(data: bytes | ByteArray, hints: Hints | None = None, source: str = "stream") -> ImuLog:
    """Read the samples in a run of bytes from the sensor.

    The bytes may start in the middle of a message and have losses; the notes tell what was skipped.

    Parameters
    ----------
    data : bytes or ndarray of uint8
    hints : Hints, optional
    source : str
        Name of the bytes in errors.

    Returns
    -------
    ImuLog

    Raises
    ------
    InvalidInputError
        If they hold no data message, or lack what is needed to understand one.
    """
    with naming(source):
        frames, notes = find_frames(data), list[str]()
        data_mask = np.isin(frames.mid, _DATA)
        if not data_mask.any():
            content = f"{len(frames)} others in {frames.data.size} bytes"
            raise InvalidInputError(
                f"expected messages with data, got {content if frames.data.any() else 'nothing but zeros'}"
            )
        kinds = frames.mid.astype(np.uint16) * 256 + frames.bid
        indices = np.flatnonzero(data_mask & (kinds == np.bincount(kinds[data_mask]).argmax()))
        if runs := frames.gaps():
            size = sum(length for _, length in runs)
            places = f"{len(runs)} places, first at byte {runs[0][0]}"
            notes.append(f"{size} bytes in {places}, belong to no message")
        if left_out := int(data_mask.sum()) - indices.size:
            notes.append(f"{left_out} data messages of another kind or unit were left out")
        read = legacy_samples if frames.mid[indices[0]] == MessageId.MT_DATA else mtdata2_samples
        parts = read(frames, indices)
        parts = replace(parts, notes=(*notes, *parts.notes))
        del data, frames, indices  # as large as the samples
        return assemble_log(parts, hints or Hints(), source)
