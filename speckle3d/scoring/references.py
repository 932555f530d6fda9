"""What a sweep's reconstruction is compared with: the simulation's truth, or the position sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import Sweep

REFERENCES = ("tracker", "truth")


@dataclass(frozen=True)
class Reference:
    """Poses that modes are compared with.

    Attributes
    ----------
    name : {"tracker", "truth"}
    world_from_image : RigidTransform, length k
        At the covered frames.
    covered : ndarray of bool, shape (n,)
        Which of the sweep's n frames have a reference; k of them.
    """

    name: str
    world_from_image: RigidTransform
    covered: BoolArray


def require_reference(wanted: str | None) -> None:
    """Raise `InvalidInputError` unless `wanted` is None or one of `REFERENCES`."""
    if wanted is not None and wanted not in REFERENCES:
        raise InvalidInputError(f"expected a reference among {', '.join(REFERENCES)}; got {wanted!r}")


def find_reference(sweep: Sweep, wanted: str | None = None) -> Reference | None:
    """Poses to compare a sweep's modes with: by default the truth if stored, else the tracker, else None.

    Parameters
    ----------
    sweep : Sweep
    wanted : {"tracker", "truth"}, optional

    Raises
    ------
    InvalidInputError
        If `wanted` is neither.
    InsufficientDataError
        If the sweep does not have what is wanted.
    """
    require_reference(wanted)
    if sweep.truth is not None and wanted != "tracker":
        return Reference("truth", sweep.truth, np.ones(len(sweep), dtype=bool))
    if wanted == "truth":
        raise InsufficientDataError(f"{sweep.name}: expected true poses in /truth, got none")
    if sweep.tracker is not None and sweep.tracker.sensor_from_image is not None:
        covered = sweep.tracker.covers(sweep.frame_time_s)
        if covered.sum() >= 2:
            poses = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
            return Reference("tracker", poses, covered)
    if wanted == "tracker":
        raise InsufficientDataError(f"{sweep.name}: expected a calibrated tracker over the frames, got none")
    return None
