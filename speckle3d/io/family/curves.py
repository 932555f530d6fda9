"""Decorrelation curves on disk (format ``speckle3d.curves``, version 1; 2 with a spectrum)."""

import numpy as np

from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings
from speckle3d.io.family.records import put, put_fields, read_record, written
from speckle3d.io.family.sweeps import read_signal
from speckle3d.io.hdf5 import PathLike, open_family, read_text

FORMAT = "speckle3d.curves"


def write_curves(path: PathLike, curves: DecorrelationCurves) -> None:
    """Write decorrelation curves; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        HDF5 file to write.
    curves : DecorrelationCurves

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    signal = curves.key.signal
    with written(path, FORMAT, 1 if curves.spectrum is None else 2) as file:
        put_fields(file, curves, skip=["key"])
        put_fields(file, curves.key, skip=["signal"])
        put_fields(file, signal)
        put(file, "signal", "rf" if isinstance(signal, RFSettings) else "bmode")


def read_curves(path: PathLike) -> DecorrelationCurves:
    """Read decorrelation curves, and check them.

    Parameters
    ----------
    path : path
        HDF5 file of `speckle3d calibrate curves`.

    Returns
    -------
    DecorrelationCurves

    Raises
    ------
    FileError
        If the file is missing, truncated or not HDF5.
    InvalidInputError
        Naming the file and what in it is wrong.

    Examples
    --------
    >>> curves = read_curves("data/curves.h5")
    >>> curves.correlation.shape == (curves.depth_mm.size, curves.distance_mm.size)
    True
    >>> curves.key.correlation_of
    'echo'
    """
    with open_family(path, FORMAT, (1, 2)) as file:
        signal = read_signal(file, read_text(file, "signal"))
        key = read_record(file, CurveKey, signal=signal)
        curves = read_record(file, DecorrelationCurves, key=key)
        if not curves.depth_mm.size or not (np.diff(curves.depth_mm) > 0).all():
            raise InvalidInputError("/depth_mm: expected depths that increase, got others")
        return curves


load_curves = read_curves
"""Its public name, `speckle3d.load_curves`."""
