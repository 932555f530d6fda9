"""NIfTI files by nibabel; their world is right, anterior, superior.

Numbers in a NIfTI-1 header are of single precision: places are kept to some 1e-7 of their distance from the
origin.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.volume import Volume
from speckle3d.io.hdf5 import reading
from speckle3d.io.headers import mm_per

_SIZES = {size.to_bytes(4, order) for size in (348, 540) for order in ("little", "big")}
"""First bytes: the length of the header of NIfTI-1 and NIfTI-2."""
_RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
_LABELS = "label"
"""Intent of an image of labels."""
_OWN = "speckle3d"
_LONGEST = 2**15
"""Voxels along an axis that NIfTI-1 does not count."""


def is_nifti(path: Path, start: bytes) -> bool:
    """Whether a file is NIfTI by its first bytes; one packed by gzip, by its name."""
    return start[:4] in _SIZES or (start.startswith(b"\x1f\x8b") and path.name.lower().endswith(".nii.gz"))


def write_nifti(path: Path, volume: Volume, fields: Mapping[str, str], is_labels: bool) -> None:
    """Write an image of NIfTI-1, or of NIfTI-2 where it is longer than that counts."""
    kind: Any = nibabel.Nifti2Image if max(volume.shape) >= _LONGEST else nibabel.Nifti1Image
    image = kind(volume.voxels, _RAS_FROM_LPS @ volume.world_from_index)
    image.set_qform(image.affine, 1)
    image.set_sform(image.affine, 1)
    image.header.set_xyzt_units("mm")
    if is_labels:
        image.header.set_intent(_LABELS)
    if fields:
        text = json.dumps({_OWN: dict(fields)}, ensure_ascii=False).encode("utf-8", "backslashreplace")
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", text))
    nibabel.save(image, path)


def read_nifti(path: Path) -> tuple[npt.NDArray[Any], FloatArray, dict[str, str], bool]:
    """Read an image of NIfTI-1 or NIfTI-2, of one file or two.

    Returns
    -------
    voxels : ndarray
    world_from_index : ndarray, shape (4, 4)
        LPS, mm, by the header's unit; a header without one means mm.
    fields : dict of str to str
        Of this package's own comment.
    is_labels : bool

    Raises
    ------
    FileError
        In nibabel's words, if it is truncated or damaged.
    """
    with reading(path, Exception):  # a damaged file shows in whatever nibabel happens to stumble over
        image: Any = nibabel.load(path)
        voxels = np.asanyarray(image.dataobj)
        factor = mm_per(image.header.get_xyzt_units()[0], str(path))
        is_labels = image.header.get_intent()[0] == _LABELS
    while voxels.ndim > 3 and voxels.shape[-1] == 1:
        voxels = voxels[..., 0]
    affine = np.diag([factor, factor, factor, 1.0]) @ _RAS_FROM_LPS @ image.affine
    fields: dict[str, str] = {}
    for extension in image.header.extensions:
        with suppress(ValueError, LookupError, TypeError, AttributeError):  # of somebody else
            fields |= json.loads(bytes(extension.get_content()).rstrip(b"\0"))[_OWN]
    return voxels, affine, fields, is_labels
