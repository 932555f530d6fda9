"""Headers of volumes as NRRD and MetaImage files: where voxels lie, of which type they are, and fields.

World axes are written as left, posterior, superior (LPS), mm.

References
----------
.. [1] G. Kindlmann, "Definition of NRRD File Format", teem.sourceforge.net.
.. [2] MetaIO documentation, Insight Software Consortium.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.core.volume import VOXEL_TYPES, require_spacing
from speckle3d.io.header_text import header_bytes, meta_start
from speckle3d.io.pixels import meta_type, nrrd_type

PREFIX = "Speckle3D_"
"""Before the names of a volume's fields, so that none is taken for one of the format's own."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
_FROM = ("RL", "AP", "IS")
"""Side that an axis comes from, by MetaImage's letters, if it leads along a world axis or against it."""


@dataclass(frozen=True)
class VolumeHeader:
    """What the header of a volume's file says.

    Parameters
    ----------
    shape : tuple of int
        Number of voxels along i, j and k.
    spacing_mm : tuple of float
    world_from_grid : RigidTransform
        Pose of voxel ``[0, 0, 0]`` in a world whose axes lead left, posterior and superior; mm.
    dtype : dtype
        A type in `VOXEL_TYPES`.
    fields : mapping of str to str
        Names are of letters, digits and ``_.-``, after a letter.
    plain : mapping of str to str
        Fields that other programs know, whose names get no prefix.

    Raises
    ------
    InvalidInputError
        Naming the argument that is not what it must be.
    """

    shape: tuple[int, int, int]
    spacing_mm: tuple[float, float, float]
    world_from_grid: RigidTransform
    dtype: np.dtype[np.generic]
    fields: Mapping[str, str]
    plain: Mapping[str, str]

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InvalidInputError(f"shape: expected three lengths above zero, got {self.shape}")
        if self.dtype.name not in VOXEL_TYPES:
            raise InvalidInputError(f"dtype: expected {', '.join(VOXEL_TYPES)}, got {self.dtype}")
        require_spacing(self.spacing_mm)
        if not self.world_from_grid.single or not np.isfinite(self.world_from_grid.as_matrix()).all():
            raise InvalidInputError("world_from_grid: expected one finite pose, got another")
        for name in self.fields:
            if not _NAME.fullmatch(name):
                raise InvalidInputError(
                    f"fields: expected names of letters, digits and '_.-' after a letter, got {name!r}"
                )

    @property
    def axes(self) -> FloatArray:
        """Directions of the grid's axes in the world, a row each."""
        return np.asarray(self.world_from_grid.rotation.as_matrix().T)

    @property
    def origin_mm(self) -> FloatArray:
        """Centre of voxel ``[0, 0, 0]``, shape (3,)."""
        return np.asarray(self.world_from_grid.translation)

    @property
    def all_fields(self) -> Iterator[tuple[str, str]]:
        """Names as they are in a file, and values of one line."""
        yield from ((f"{PREFIX}{name}", escaped(value)) for name, value in self.fields.items())
        yield from ((name, escaped(value)) for name, value in self.plain.items())


def nrrd_header(header: VolumeHeader, encoding: str) -> bytes:
    """Header of an NRRD file with its voxels behind it, packed as `encoding` says."""
    steps = header.axes * np.asarray(header.spacing_mm)[:, None]
    return header_bytes(
        (
            "NRRD0005",
            f"type: {nrrd_type(header.dtype)}",
            "dimension: 3",
            "space: left-posterior-superior",
            f"sizes: {_texts(header.shape)}",
            f"space directions: {' '.join(_vector(step) for step in steps)}",
            "kinds: domain domain domain",
            "endian: little",
            f"encoding: {encoding}",
            'space units: "mm" "mm" "mm"',
            f"space origin: {_vector(header.origin_mm)}",
            *(f"{name}:={value}" for name, value in header.all_fields),
            "",
        )
    )


def meta_header(header: VolumeHeader, is_packed: bool) -> bytes:
    """Header of a MetaImage with its voxels behind it; `put_packed_size` tells it their size."""
    return header_bytes(
        (
            *meta_start(3, 0 if is_packed else None),
            f"TransformMatrix = {_texts(header.axes.ravel())}",
            f"Offset = {_texts(header.origin_mm)}",
            "CenterOfRotation = 0 0 0",
            f"AnatomicalOrientation = {_anatomical_orientation(header.axes)}",
            f"ElementSpacing = {_texts(header.spacing_mm)}",
            f"DimSize = {_texts(header.shape)}",
            # As PLUS tells a volume from a sequence of frames.
            "Kinds = domain domain domain",
            *(f"{name} = {value}" for name, value in header.all_fields),
            f"ElementType = MET_{meta_type(np.dtype(header.dtype))}",
            "ElementDataFile = LOCAL",
        )
    )


def escaped(text: str) -> str:
    r"""Write text on one line, with line breaks and backslashes as NRRD has them: ``\n`` and ``\\``.

    Blanks at its ends are lost, and control characters are shown as Python writes them.
    """
    shown = printable(text.strip().replace("\r\n", "\n"), kept="\n")
    return shown.replace("\\", "\\\\").replace("\n", "\\n")


def unescaped(text: str) -> str:
    """Undo `escaped`."""
    return re.sub(r"\\([n\\])", lambda found: "\n" if found[1] == "n" else "\\", text)


def own_fields(fields: Mapping[str, str]) -> dict[str, str]:
    """Fields of a volume among those in a header."""
    return {
        name.removeprefix(PREFIX): unescaped(value)
        for name, value in fields.items()
        if name.startswith(PREFIX) and name != PREFIX
    }


def _anatomical_orientation(axes: FloatArray) -> str:
    """Letters of the sides that axes come from, of the nearest grid along the world's axes: RAI is LPS."""
    along = max(
        itertools.permutations(range(3)), key=lambda order: sum(abs(axes[i, n]) for i, n in enumerate(order))
    )
    return "".join(_FROM[n][0 if axes[i, n] >= 0 else 1] for i, n in enumerate(along))


def _texts(values: Iterable[float] | npt.NDArray[np.float64]) -> str:
    return " ".join(_text(value) for value in values)


def _vector(values: Iterable[float]) -> str:
    return f"({','.join(_text(value) for value in values)})"


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value) + 0.0)
