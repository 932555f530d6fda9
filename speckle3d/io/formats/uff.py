"""Beamformed data in the ultrasound file format of USTB, the UltraSound ToolBox (``.uff``, HDF5) [1]_.

Every object is a group whose attribute ``class`` names it. Of ``uff.beamformed_data`` are read ``data``, of
pixels, channels, waves and frames, which MATLAB writes with its first index running fastest, so that HDF5
shows the axes in reverse; ``scan``, a ``uff.linear_scan`` with ``x_axis`` and ``z_axis`` in metres, of which
z runs fastest over the pixels; ``modulation_frequency`` in Hz, by which complex data were shifted down, and
0 where they were not; and ``pulse``, with ``center_frequency`` in Hz and ``fractional_bandwidth`` as a share
of it. Complex data are a group of ``real`` and ``imag``.

``frame_rate`` is that of videos to be made of the data, 1 unless set: it is told, not used.

References
----------
.. [1] A. Rodriguez-Molares et al., "The UltraSound ToolBox", IEEE Int. Ultrasonics Symp., 2017.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.io.carrier import demodulation_of
from speckle3d.io.formats.hdf5_values import Grid, HDF5File, dataset, flat, member, single, text_attribute
from speckle3d.io.frames import FileFrames
from speckle3d.io.hdf5 import hdf5_claim, open_hdf5, reading
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, step_of, where_of

FORMAT = "USTB .uff"

_BEAMFORMED, _CHANNELS, _LINEAR = "uff.beamformed_data", "uff.channel_data", "uff.linear_scan"


def is_uff(file: h5py.File) -> bool:
    """Whether an open file holds objects of USTB."""
    return "format" not in file.attrs and any(kind.startswith("uff.") for kind in _objects(file).values())


def open_uff(path: Path, settings: ImportSettings) -> Recording:
    """Read beamformed RF or I/Q on a linear scan; real data of one sign become grey levels."""
    with reading(path), open_hdf5(path) as file:
        rows: list[Row] = [("object", f"{name}: {kind}", "") for name, kind in _objects(file).items()]
        try:
            return _recording(path, settings, file, rows)
        except InvalidInputError as error:
            return Recording(path, settings, rows=tuple(rows), fault=error)


def _recording(path: Path, settings: ImportSettings, file: h5py.File, rows: list[Row]) -> Recording:
    name = _chosen(file, path, settings)
    group = file[name]
    x_mm, z_mm = _axes(path, group)
    data = f"{name}/data"
    is_complex = isinstance(member(file, data), h5py.Group)
    parts = (f"{data}/real", f"{data}/imag") if is_complex else (data,)
    shapes = {dataset(file, part).shape for part in parts}
    axis, count = _frame_axis(where_of(path, data), shapes.pop() if len(shapes) == 1 else (), x_mm, z_mm)
    modulation_hz = single(group, "modulation_frequency") or 0.0
    spacing = step_of(z_mm, where_of(path, f"{name}/scan/z_axis"))
    if (video := single(group, "frame_rate")) is not None:
        rows.append(("frame rate of videos made of it, not used", f"{video:g}", "frames/s"))
    pitch = step_of(x_mm, where_of(path, f"{name}/scan/x_axis"))
    values = {
        "vector_pitch_mm": Value(pitch, f"in {name}/scan/x_axis"),
        "first_sample_depth_mm": Value(float(z_mm[0]), f"in {name}/scan/z_axis"),
        **_speed(file),
        **_pulse(group, f"in {name}", modulation_hz),
    }
    grid, shape = Grid((x_mm.size, z_mm.size), (0, 1)), (count, x_mm.size, z_mm.size)
    source = HDF5File(path, parts, axis, grid)
    frames = source.frames(shape, np.complex64 if is_complex else np.float32)
    if is_complex:
        if settings.demodulation_frequency_hz is None and count:
            _require_phase(path, frames, values, modulation_hz, spacing, settings)
        values["demodulation_frequency_hz"] = Value(modulation_hz, f"in {name}/modulation_frequency")
    elif count and (kind := _kind_of(frames)) != "RF":
        given = settings.dynamic_range_db
        frames, top, span = source.grey_frames(shape, grid, kind == "decibels", given)
        rows.append(("data", f"of one sign: {kind}, made grey levels here", ""))
        values |= {
            "column_pitch_mm": values["vector_pitch_mm"],
            "row_spacing_mm": Value(spacing, f"in {name}/scan/z_axis"),
            "dynamic_range_db": Value(span, f"of grey levels made here below {top:g}"),
        }
    return Recording(path, settings, frames, values, sample_spacing_mm=spacing, rows=tuple(rows))


def _objects(file: h5py.File) -> dict[str, str]:
    """Classes of the root's groups, by their names."""
    groups = {str(name): member(file, name) for name in file}
    kinds = {
        printable(name): text_attribute(group, "class")
        for name, group in groups.items()
        if isinstance(group, h5py.Group)
    }
    return {name: kind for name, kind in kinds.items() if kind}


def _kind_of(frames: FileFrames) -> str:
    """What real numbers are, by their signs: echoes swing to both sides, amplitudes and decibels do not."""
    frame = frames[len(frames) // 2]
    if frame.min() < 0 < frame.max():
        return "RF"
    return "decibels" if frame.min() < 0 else "an envelope"


def _require_phase(
    path: Path,
    frames: FileFrames,
    values: dict[str, Value],
    modulation_hz: float,
    spacing_mm: float,
    settings: ImportSettings,
) -> None:
    """Refuse a modulation frequency that contradicts how the phase of the data turns."""
    carried = modulation_hz or values.get("centre_frequency_hz", Value(0.0)).value
    if not carried:
        return
    own = values.get("speed_of_sound_m_s", Value(SPEED_OF_SOUND_M_S)).value
    rate_hz = 1e3 * (settings.speed_of_sound_m_s or own) / (2.0 * spacing_mm)
    with naming(str(path)):
        shift_hz = demodulation_of(frames, carried, rate_hz)
        if shift_hz is not None and bool(shift_hz) != bool(modulation_hz):
            says = f"shifted down by {carried:g} Hz" if shift_hz else f"still carrying {carried:g} Hz"
            raise InvalidInputError(
                f"modulation_frequency: expected that of data {says}, as their phase tells, got "
                f"{modulation_hz:g}: give --demodulation-frequency-hz, 0 where it is still carried"
            )


def _chosen(file: h5py.File, path: Path, settings: ImportSettings) -> str:
    """Name of the beamformed data to read."""
    objects = _objects(file)
    names = [name for name, kind in objects.items() if kind == _BEAMFORMED]
    asked = settings.arrays.get("data")
    if asked in names:
        return str(asked)
    if len(names) == 1 and asked is None:
        return names[0]
    if names:
        raise InvalidInputError(
            f"{path}: expected one {_BEAMFORMED}, got {', '.join(names)}: say which by arrays = "
            f'{{ data = "{names[0]}" }} in {path.name}.toml beside it'
        )
    held = ", ".join(sorted(set(objects.values())))
    advice = f": beamform it by USTB's das on a {_LINEAR}" if _CHANNELS in objects.values() else ""
    raise InvalidInputError(f"{path}: expected {_BEAMFORMED}, got {held}{advice}")


def _axes(path: Path, group: h5py.Group) -> tuple[FloatArray, FloatArray]:
    """Lateral positions and depths, mm; pixels must be in USTB's order where the file lists their places."""
    scan = member(group, "scan")
    kind = text_attribute(scan, "class") if isinstance(scan, h5py.Group) else ""
    where = where_of(path, f"{group.name}/scan")
    if kind != _LINEAR:
        raise InvalidInputError(
            f"{where}: expected a {_LINEAR}, got {kind or 'none'}: beamform onto a {_LINEAR}, whose lines "
            "are "
            "parallel"
        )
    x, z = flat(scan, "x_axis"), flat(scan, "z_axis")
    for name, expected in (("x", np.repeat(x, z.size)), ("z", np.tile(z, x.size))):
        if member(scan, name) is None:
            continue
        held, scale = flat(scan, name), float(np.abs(expected).max(initial=0.0)) or 1.0
        if held.shape != expected.shape or np.abs(held - expected).max(initial=0.0) > 1e-4 * scale:
            raise InvalidInputError(
                f"{where}/{name}: expected those of {x.size} x {z.size} pixels, z fastest, got others"
            )
    return 1e3 * x, 1e3 * z


def _frame_axis(
    where: str, shape: tuple[int, ...], x_mm: FloatArray, z_mm: FloatArray
) -> tuple[int | None, int]:
    """Axis of the frames in the file, None where it has none, and their number.

    MATLAB leaves out axes of length 1 at its end, which is the beginning in the file; pyuff keeps MATLAB's
    order.
    """
    pixels, full = x_mm.size * z_mm.size, len(shape) == 4
    reverse = shape[-1:] == (pixels,) and set(shape[1:-1] if full else shape[:-1]) <= {1}
    forward = shape[:1] == (pixels,) and set(shape[1:3]) <= {1}
    if len(shape) <= 4 and (reverse != forward or (reverse and not full)):
        if not full:
            return None, 1
        axis = 0 if reverse else 3
        return axis, shape[axis]
    raise InvalidInputError(
        f"{where}: expected {pixels} pixels ({x_mm.size} x {z_mm.size}) of one channel and one wave, summed, "
        f"got (MATLAB's order) {shape[::-1]}"
    )


def _pulse(group: h5py.Group, where: str, modulation_hz: float) -> dict[str, Value]:
    """Centre frequency, of the pulse or else what the data were shifted down by, and the pulse's band."""
    centre = single(group, "pulse/center_frequency")
    share = single(group, "pulse/fractional_bandwidth")
    values = {}
    if centre:
        values["centre_frequency_hz"] = Value(centre, f"{where}/pulse/center_frequency")
    elif modulation_hz:
        values["centre_frequency_hz"] = Value(modulation_hz, f"assumed: {where}/modulation_frequency")
    if centre and share:
        band = (centre * (1.0 - share / 2.0), centre * (1.0 + share / 2.0))
        values["bandwidth_hz"] = Value(band, f"{where}/pulse/fractional_bandwidth")
    return values


def _speed(file: h5py.File) -> dict[str, Value]:
    """Speed of sound of the channel data in the same file, if there is one."""
    for name, kind in _objects(file).items():
        if kind == _CHANNELS and (speed := single(file, f"{name}/sound_speed")):
            return {"speed_of_sound_m_s": Value(speed, f"{name}/sound_speed")}
    return {}


READER = Reader(FORMAT, hdf5_claim(is_uff), open_uff)
