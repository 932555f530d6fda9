"""Decorrelation curves on disk (format ``speckle3d.curves``, version 1; 2 with a spectrum)."""

from __future__ import annotations

from dataclasses import fields
from typing import cast, get_args

import numpy as np

from speckle3d.core.curves import (
    EDGE_FRACTION,
    PATCH_NUMBERS,
    PROBE_SIGMA,
    CurveKey,
    DecorrelationCurves,
    EchoSpectra,
    NominalProbe,
    Origin,
    SpeckleSize,
    TiltResponse,
)
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.geometry import require_finite
from speckle3d.core.sweep import RFSettings
from speckle3d.io.hdf5 import (
    PathLike,
    atomic_hdf5,
    find_group,
    has_member,
    opened,
    read_attribute,
    read_attributes,
    read_checked,
    read_text,
    write_attributes,
)
from speckle3d.io.sweeps import read_signal, signal_attributes

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
    with atomic_hdf5(path, FORMAT, version=1 if curves.spectrum is None else 2) as file:
        for name in ("depth_mm", "distance_mm", "correlation", "cells"):
            file[name] = getattr(curves, name)
        for group, part in (
            ("tilt", curves.tilt),
            ("speckle", curves.speckle),
            ("spectrum", curves.spectrum),
        ):
            for name, values in vars(part).items() if part is not None else ():
                file[f"{group}/{name}"] = values
        for name in ("pairs_used", "scale_sigma", "origin"):
            file.attrs[name] = getattr(curves, name)
        write_attributes(file, curves.key, (*PATCH_NUMBERS, "correlation_of", "edge_fraction", "probe"))
        if curves.nominal is not None:
            file.create_group("nominal").attrs.update(vars(curves.nominal))
        file.attrs["signal"] = "rf" if isinstance(curves.key.signal, RFSettings) else "bmode"
        file.attrs.update(signal_attributes(curves.key.signal))


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
    with opened(path, FORMAT, (1, 2)) as file, naming(str(path)):
        depth = read_checked(file, "depth_mm", ("r",))
        require_finite(depth, "/depth_mm")
        if not depth.size or (np.diff(depth) <= 0).any():
            raise InvalidInputError("/depth_mm: expected depths that increase, got others")
        distance = read_checked(file, "distance_mm", ("k",))
        require_finite(distance, "/distance_mm")
        correlation = read_checked(file, "correlation", (depth.size, distance.size))
        cells = read_checked(file, "cells", (depth.size,))
        numbers = read_attributes(file, dict.fromkeys(PATCH_NUMBERS, float))
        of = read_text(file, "correlation_of") if "correlation_of" in file.attrs else "intensity"
        kind = read_text(file, "signal")
        if kind not in ("rf", "bmode"):
            raise InvalidInputError(f"attribute signal: expected 'rf' or 'bmode', got {kind!r}")
        edge = read_attribute(file, "edge_fraction", EDGE_FRACTION)
        probe = read_text(file, "probe") if "probe" in file.attrs else ""
        key = CurveKey(read_signal(file, kind), **numbers, correlation_of=of, edge_fraction=edge, probe=probe)
        pairs = int(read_attribute(file, "pairs_used", 0))
        sigma = read_attribute(file, "scale_sigma", PROBE_SIGMA)
        origin = _origin(read_text(file, "origin")) if "origin" in file.attrs else "phantom"
        tilt = speckle = None
        if has_member(file, "tilt"):
            names = ("tilt/pivot_mm", "tilt/spread_mm")
            tilt = TiltResponse(*(read_checked(file, name, (depth.size,)) for name in names))
        if has_member(file, "speckle"):
            names = ("speckle/lateral_mm", "speckle/axial_mm")
            speckle = SpeckleSize(*(read_checked(file, name, (depth.size,)) for name in names))
        spectrum = None
        if has_member(file, "spectrum"):
            rows = read_checked(file, "spectrum/depth_mm", ("y",))
            frequency = read_checked(file, "spectrum/frequency_hz", ("f",))
            power = read_checked(file, "spectrum/power", (rows.size, frequency.size))
            spectrum = EchoSpectra(rows, frequency, power)
        nominal = None
        if (group := find_group(file, "nominal")) is not None:
            kinds = dict.fromkeys((field.name for field in fields(NominalProbe)), float)
            nominal = NominalProbe(**read_attributes(group, kinds))
        parts = tilt, speckle, sigma, origin, nominal, spectrum
        return DecorrelationCurves(key, depth, distance, correlation, cells, pairs, *parts)


def _origin(name: str) -> Origin:
    for known in get_args(Origin):
        if name == known:
            return cast(Origin, known)
    raise InvalidInputError(f"attribute origin: expected one of {get_args(Origin)}, got {name!r}")


load_curves = read_curves
"""Its public name, `speckle3d.load_curves`."""
