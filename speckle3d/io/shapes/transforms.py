"""Poses as ITK transform files of text (.tfm), which 3D Slicer reads.

ITK's files hold what takes points of the parent to those of the child, as for resampling [1]_; Slicer shows
its inverse as the node's "transform to parent". So what is written is `world_from_image`'s inverse, in axes
that lead left, posterior and superior, mm. A node with that transform has image coordinates of P below it.

References
----------
.. [1] 3D Slicer user guide, "Transforms", section "ITK transform files".
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.hdf5 import atomic_path, require_suffix
from speckle3d.io.text import number_text

SUFFIX = ".tfm"

_TYPE = "AffineTransform_double_3_3"
"""Rigid, but of the type that all of ITK's readers know."""


def write_transform(path: PathLike, world_from_image: RigidTransform) -> None:
    """Write one pose as a transform of ITK; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        Ends in .tfm.
    world_from_image : RigidTransform
        A single pose; its world's axes lead left, posterior and superior; mm.

    Raises
    ------
    InvalidInputError
        If the suffix is another, or the pose is a row of poses: Slicer reads one transform of a file.
    FileError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_transform(f"{folder}/t.tfm", RigidTransform.from_translation([1.0, 2.0, 3.0]))
    ...     print(Path(f"{folder}/t.tfm").read_text().splitlines()[3])
    Parameters: 1 0 0 0 1 0 0 0 1 -1 -2 -3
    """
    require_suffix(path, [SUFFIX])
    if not world_from_image.single:
        raise InvalidInputError(f"{path}: expected one pose, got a row of {len(world_from_image)}")
    matrix = world_from_image.inv().as_matrix()
    # Matrix, row by row, and translation.
    parameters = np.concatenate((matrix[:3, :3].ravel(), matrix[:3, 3]))
    lines = (
        "#Insight Transform File V1.0",
        "#Transform 0",
        f"Transform: {_TYPE}",
        f"Parameters: {number_text(parameters)}",
        "FixedParameters: 0 0 0",
    )
    with atomic_path(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="ascii")
