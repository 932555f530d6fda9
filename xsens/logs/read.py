"""Read logs of the sensor; the kind of a log is told by its content, never by its name."""

from io import TextIOWrapper

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from xsens.logs.assembly import Hints
from xsens.logs.datamessages import parse_stream
from xsens.logs.samples import ImuLog
from xsens.logs.textlogs import parse_text
from xsens.messages.framing import find_frames

_HEAD_BYTES = 1 << 16
_WIDE = (b"\xff\xfe", b"\xfe\xff")
"""First bytes of text whose characters take two bytes."""


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
