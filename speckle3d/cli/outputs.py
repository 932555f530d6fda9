"""Overwrite rules: never an input, and only files of the command's own kind."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from speckle3d.core.errors import InvalidInputError

_FIRST_BYTES = 2**16


def require_own_places(places: Sequence[tuple[Path, str]], inputs: Iterable[Any], results: Any) -> None:
    """Refuse places of outputs that are one, or that `require_own_place` refuses.

    Parameters
    ----------
    places : sequence of (path, str)
        Where the command writes, and what.
    inputs : iterable
        Values of its other options; texts may be names of files, too.
    results : path or None
        Folder that the command makes, in which nothing can be in the way.
    """
    items = [item for value in inputs for item in (value if isinstance(value, list) else [value])]
    files = [Path(item) for item in items if isinstance(item, str | Path) and os.path.isfile(item)]
    for path, kind in places:
        if path.parent != results or results.exists():
            require_own_place(path, kind, *files)
    if len({path.resolve() for path, _ in places}) < len(places):
        raise InvalidInputError(f"{places[0][0]}: expected a file of its own for each output")


def require_own_place(out: Path, kind: str, *inputs: Path) -> None:
    """Refuse to write over an input, or over another kind of file than the command writes.

    Parameters
    ----------
    out : path
        A file without content is always free.
    kind : str
        What the command writes: one of `_kinds_of`, or several.
    inputs : path
        Files that the command reads.

    Raises
    ------
    FileError
        If the place cannot be written.
    InvalidInputError
        If it is taken.
    """
    from speckle3d.io.hdf5 import LABELS_ALONE, require_suffix, require_target
    from speckle3d.io.shapes import SUFFIXES as SURFACES
    from speckle3d.io.voxels.volumes import SUFFIXES as VOLUMES

    target, kinds = require_target(out), kind.split()
    suffixes = {
        "picture": (".png",), "surface": SURFACES, "volume": VOLUMES, "labels": (LABELS_ALONE,),
        "simulation": (".h5", ".hdf5"),
    }  # fmt: skip
    if endings := [suffix for name in kinds for suffix in suffixes.get(name, ())]:
        require_suffix(out, endings)
    targets = [target]
    if kind == "calibration":
        from speckle3d.calibrating.written import BESIDE

        targets += [target.with_suffix(suffix) for suffix in BESIDE]
        if out.suffix in BESIDE:
            raise InvalidInputError(f"{out}: expected a calibration file, not {', '.join(BESIDE)} beside it")
    for path in inputs:
        if any(place.exists() and path.samefile(place) for place in targets):
            raise InvalidInputError(f"{path}: is an input and would be overwritten: give -o another name")
    if target.exists() and target.stat().st_size and _kinds_of(target).isdisjoint(kinds):
        nouns = " or ".join(kinds)
        raise InvalidInputError(
            f"{out}: expected a new name or a {nouns} to replace, got another kind of file"
        )


def _kinds_of(path: Path) -> set[str]:
    """Kinds that a file may be, by its content."""
    from speckle3d.io.hdf5 import SIGNATURE, file_format, open_hdf5
    from speckle3d.io.images.headers import is_image
    from speckle3d.io.tum import is_tum
    from speckle3d.io.voxels.volumes import is_nifti

    with path.open("rb") as stream:
        start = stream.read(_FIRST_BYTES)
    if start.startswith(SIGNATURE):
        with open_hdf5(path) as file:
            kind = file_format(file).removeprefix("speckle3d.")
            return {kind, *({"simulation"} & {*file})}
    is_sequence, triangles = b"Seq_Frame" in start, int.from_bytes(start[80:84], "little")
    signs = {
        "log": b"\ntime_s," in b"\n" + start,
        "picture": start.startswith(b"\x89PNG\r\n\x1a\n"),
        "sequence": is_sequence,
        "surface": start.startswith((b"ply", b"# vtk DataFile", b"solid"))
        or path.stat().st_size == 84 + 50 * triangles,  # binary STL
        "trajectory": is_tum(path),
        # Programs may not say what their axes are.
        "volume": is_nifti(path, start) or (is_image(start) and not is_sequence),
    }
    return {kind for kind, applies in signs.items() if applies}
