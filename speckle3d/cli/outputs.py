"""What a command may write over: never an input, and of other files only its own kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from speckle3d.core.errors import FileError, InvalidInputError

Kind = Literal[
    "calibration",
    "curves",
    "log",
    "picture",
    "sequence",
    "simulation",
    "surface",
    "sweep",
    "trajectory",
    "transform",
    "volume",
]

_FIRST_BYTES = 4096
_PNG = b"\x89PNG\r\n\x1a\n"


def require_own_place(out: Path, kind: Kind, *inputs: Path | None) -> None:
    """Refuse to write over an input, or over another kind of file than the command writes.

    Parameters
    ----------
    out : path
        A file without content is always free.
    kind : str
        What the command writes.
    inputs : path or None
        Files that the command reads.

    Raises
    ------
    FileError
        If the place cannot be written.
    InvalidInputError
        If it is taken.
    """
    from speckle3d.io.hdf5 import require_target

    target = require_target(out)
    if not target.exists():
        return
    if any(path is not None and path.exists() and path.samefile(target) for path in inputs):
        raise InvalidInputError(f"{out}: is an input and would be overwritten: give another name")
    words, is_own = _KINDS[kind]
    if target.stat().st_size and not is_own(target):
        raise InvalidInputError(f"{out}: expected a new name or {words} to replace, got another kind of file")


def require_own_places(outputs: Mapping[str, Path | None], kind: Kind, *inputs: Path | None) -> None:
    """Refuse as `require_own_place` for each output, by its option, and if two are one file."""
    taken: dict[Path, str] = {}
    for option, out in outputs.items():
        if out is not None:
            require_own_place(out, kind, *inputs)
            other = taken.setdefault(out.resolve(), option)
            if other != option:
                raise InvalidInputError(f"{option}: expected another file than {other}, got {out} for both")


def _of_format(wanted: str) -> Callable[[Path], bool]:
    def is_of_format(path: Path) -> bool:
        from speckle3d.io.load import kind_of

        try:
            return kind_of(path) == wanted
        except (FileError, InvalidInputError):
            return False

    return is_of_format


def _is_simulation(path: Path) -> bool:
    from speckle3d.io.hdf5 import open_hdf5

    if not _of_format("speckle3d.sweep")(path):
        return False
    with open_hdf5(path) as file:
        return "simulation" in file


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_FIRST_BYTES)


def _is_picture(path: Path) -> bool:
    return _start(path).startswith(_PNG)


def _is_log(path: Path) -> bool:
    """Whether a file begins as `xsens.write_csv` writes it: comments, then a heading from ``time_s`` on."""
    with path.open("rb") as lines:
        return next((line for line in lines if not line.startswith(b"#")), b"").startswith(b"time_s,")


def _is_volume(path: Path) -> bool:
    from speckle3d.io.voxels.volumes import may_be_volume

    return may_be_volume(path)


def _is_sequence(path: Path) -> bool:
    """Whether a file is a MetaImage or NRRD sequence of frames, or has no pixels of its own."""
    from speckle3d.io.headers import is_metaimage, is_nrrd

    start = _start(path)
    return (is_metaimage(start) or is_nrrd(start)) and b"Seq_Frame" in start


def _is_surface(path: Path) -> bool:
    """Whether a file is a surface: STL by its size, PLY and VTK by how they begin."""
    start = _start(path)
    if start.startswith(b"ply") or start.startswith(b"# vtk DataFile"):
        return True
    count = int.from_bytes(start[80:84], "little")
    return path.stat().st_size == 84 + 50 * count or start.startswith(b"solid")


def _is_trajectory(path: Path) -> bool:
    from speckle3d.io.tum import is_tum

    return is_tum(path)


def _is_transform(path: Path) -> bool:
    """Whether a file is a transform of ITK, as text or HDF5."""
    from speckle3d.io.hdf5 import SIGNATURE, open_hdf5

    start = _start(path)
    if not start.startswith(SIGNATURE):
        return start.startswith(b"#Insight Transform File")
    with open_hdf5(path) as file:
        return "TransformGroup" in file


_KINDS: dict[Kind, tuple[str, Callable[[Path], bool]]] = {
    "calibration": ("a calibration", _of_format("speckle3d.calibration")),
    "curves": ("curves", _of_format("speckle3d.curves")),
    "log": ("a CSV of a sensor's log", _is_log),
    "picture": ("a PNG", _is_picture),
    "sequence": ("an image sequence", _is_sequence),
    "simulation": ("a simulated sweep", _is_simulation),
    "surface": ("a surface", _is_surface),
    "sweep": ("a sweep file", _of_format("speckle3d.sweep")),
    "trajectory": ("TUM text", _is_trajectory),
    "transform": ("a transform", _is_transform),
    "volume": ("a volume", _is_volume),
}
