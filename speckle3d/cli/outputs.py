"""What a command may write over: never an input, and of other files only its own kind."""

from __future__ import annotations

from pathlib import Path

from speckle3d.core.errors import InvalidInputError

_FIRST_BYTES = 2**16


def require_own_place(out: Path, kind: str, *inputs: Path | None) -> None:
    """Refuse to write over an input, or over another kind of file than the command writes.

    Parameters
    ----------
    out : path
        A file without content is always free.
    kind : str
        What the command writes: one of `_kinds_of`.
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
    if target.stat().st_size and kind not in _kinds_of(target):
        raise InvalidInputError(
            f"{out}: expected a new name or a {kind} to replace, got another kind of file"
        )


def _kinds_of(path: Path) -> set[str]:
    """What a file may be, by its content."""
    from speckle3d.io.hdf5 import SIGNATURE, open_hdf5
    from speckle3d.io.tum import is_tum
    from speckle3d.io.voxels.volumes import may_be_volume

    with path.open("rb") as file:
        start = file.read(_FIRST_BYTES)
    if start.startswith(SIGNATURE):
        with open_hdf5(path) as held:
            own = str(held.attrs.get("format", "")).removeprefix("speckle3d.")
            return {own, *({"simulation"} & {*held})}
    triangles = int.from_bytes(start[80:84], "little")
    row = next((line for line in start.splitlines() if not line.startswith(b"#")), b"")
    signs = {
        "log": row.startswith(b"time_s,"),
        "picture": start.startswith(b"\x89PNG\r\n\x1a\n"),
        "sequence": b"Seq_Frame" in start,
        "surface": start.startswith((b"ply", b"# vtk DataFile", b"solid"))
        or path.stat().st_size == 84 + 50 * triangles,  # binary STL
        "trajectory": is_tum(path),
        "transform": start.startswith(b"#Insight Transform File"),
        "volume": may_be_volume(path),
    }
    return {kind for kind, is_one in signs.items() if is_one}
