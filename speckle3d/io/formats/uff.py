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
from speckle3d.core.sweep import Sweep
from speckle3d.io.carrier import demodulation_of
from speckle3d.io.formats.greys import grey_frames
from speckle3d.io.formats.hdf5_values import flat, single
from speckle3d.io.formats.recordings import Recording, step_of
from speckle3d.io.found import Found
from speckle3d.io.hdf5 import (
    find_group,
    find_member,
    has_member,
    hdf5_claim,
    locate,
    open_hdf5,
    plain_attribute,
    reading,
    require_dataset,
    require_group,
)
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.lazy import Complex, HDF5Slices, Layout, Real
from speckle3d.io.readers import Reader, Row

FORMAT = "USTB .uff"

_BEAMFORMED, _CHANNELS, _LINEAR = "uff.beamformed_data", "uff.channel_data", "uff.linear_scan"
_MOST_MEMBERS = 256


def read_uff(path: Path, settings: ImportSettings | None = None) -> Sweep:
    """Read beamformed RF or I/Q on a linear scan; frames stay on disk until they are asked for.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it holds no such data, or they and their axes contradict each other.
    MissingSettingsError
        Naming all that the file does not say: always the frame rate.
    """
    settings = settings or ImportSettings()
    return _recording(path, settings).sweep(settings)


def is_uff(file: h5py.File) -> bool:
    """Whether an open file holds objects of USTB."""
    return "format" not in file.attrs and any(kind.startswith("uff.") for kind in _objects(file).values())


def _describe(path: Path, settings: ImportSettings) -> list[Row]:
    try:
        return _recording(path, settings).rows(settings)
    except InvalidInputError:
        # Why there is no sweep is told beside these rows.
        with reading(path), open_hdf5(path) as file:
            return [("object", f"{name}: {kind}", "") for name, kind in _objects(file).items()]


def _objects(file: h5py.File) -> dict[str, str]:
    """Classes of the root's groups, by their names."""
    found = {}
    for name in list(file)[:_MOST_MEMBERS]:
        if isinstance(name, str) and isinstance(member := find_member(file, name), h5py.Group):
            kind = _class_of(member)
            if kind:
                found[printable(name)] = kind
    return found


def _class_of(node: h5py.Group) -> str:
    if "class" not in node.attrs:
        return ""
    value = np.ravel(plain_attribute(node, "class"))
    first = value[0] if value.size else ""
    return printable(first.decode("utf-8", "replace") if isinstance(first, bytes) else str(first)).strip("\0")


def _recording(path: Path, settings: ImportSettings) -> Recording:
    with reading(path), open_hdf5(path) as file:
        name = _chosen(file, path, settings)
        group = require_group(file, name)
        x_mm, z_mm = _axes(group)
        parts = _parts(group)
        axis, count = _layout(locate(group, "data"), _shape_of(group, parts), x_mm.size, z_mm.size)
        modulation_hz = single(group, "modulation_frequency") or 0.0
        spacing = step_of(z_mm, f"{locate(group)}/scan/z_axis")
        notes = _notes(file, group)
        found = {
            "vector_pitch_mm": Found(step_of(x_mm, f"{locate(group)}/scan/x_axis"), f"in {name}/scan/x_axis"),
            "first_sample_depth_mm": Found(float(z_mm[0]), f"in {name}/scan/z_axis"),
            **_speed(file),
            **_pulse(group, f"in {name}", modulation_hz),
        }
    layout, shape = Layout((x_mm.size, z_mm.size), (0, 1)), (count, x_mm.size, z_mm.size)
    if len(parts) == 2:
        frames = HDF5Slices(path, parts, axis, Complex(layout), shape, np.complex64)
        if settings.demodulation_frequency_hz is None and count:
            _require_phase(path, frames, found, modulation_hz, spacing, settings)
        found["demodulation_frequency_hz"] = Found(modulation_hz, f"in {name}/modulation_frequency")
        return Recording(path, frames, found, sample_spacing_mm=spacing, notes=notes)
    frames = HDF5Slices(path, parts, axis, Real(layout), shape, np.float32)
    kind = _kind_of(frames) if count else "RF"
    if kind != "RF":
        given = settings.dynamic_range_db
        frames, top, span = grey_frames(path, parts, axis, layout, shape, kind == "decibels", given)
        notes += (("data", f"of one sign: {kind}, made grey levels here", ""),)
        found |= {
            "column_pitch_mm": found["vector_pitch_mm"],
            "row_spacing_mm": Found(spacing, f"in {name}/scan/z_axis"),
            "dynamic_range_db": Found(span, f"of grey levels made here below {top:g}"),
        }
    return Recording(path, frames, found, sample_spacing_mm=spacing, notes=notes)


def _kind_of(frames: HDF5Slices) -> str:
    """What real numbers are, by their signs: echoes swing to both sides, amplitudes and decibels do not."""
    frame = frames[len(frames) // 2]
    if frame.min() < 0 < frame.max():
        return "RF"
    return "decibels" if frame.min() < 0 else "an envelope"


def _require_phase(
    path: Path,
    frames: HDF5Slices,
    found: dict[str, Found],
    modulation_hz: float,
    spacing_mm: float,
    settings: ImportSettings,
) -> None:
    """Refuse a modulation frequency that contradicts how the phase of the data turns."""
    carried = modulation_hz or found.get("centre_frequency_hz", Found(0.0)).value
    if not carried:
        return
    speed = settings.speed_of_sound_m_s or found.get("speed_of_sound_m_s", Found(SPEED_OF_SOUND_M_S)).value
    with naming(str(path)):
        told = demodulation_of(frames, carried, 1e3 * speed / (2.0 * spacing_mm))
        if told is not None and bool(told) != bool(modulation_hz):
            says = f"shifted down by {carried:g} Hz" if told else f"still carrying {carried:g} Hz"
            raise InvalidInputError(
                f"modulation_frequency: expected that of data {says}, as their phase tells, got "
                f"{modulation_hz:g}: give --demodulation-frequency-hz, 0 where it is still carried"
            )


def _chosen(file: h5py.File, path: Path, settings: ImportSettings) -> str:
    """Name of the beamformed data to read."""
    objects = _objects(file)
    there = [name for name, kind in objects.items() if kind == _BEAMFORMED]
    asked = settings.arrays.get("data")
    if asked is not None and asked in there:
        return asked
    if len(there) == 1 and asked is None:
        return there[0]
    if there:
        raise InvalidInputError(
            f"{path}: expected one {_BEAMFORMED}, got {', '.join(there)}: say which by arrays = "
            f'{{ data = "{there[0]}" }} in {path.name}.toml beside it'
        )
    if _CHANNELS in objects.values():
        raise InvalidInputError(
            f"{path}: expected {_BEAMFORMED}, got {_CHANNELS}, which needs beamforming: use USTB's das on a "
            f"{_LINEAR} and write what it gives"
        )
    held = ", ".join(sorted(set(objects.values())))
    raise InvalidInputError(f"{path}: expected {_BEAMFORMED}, got {held}")


def _axes(group: h5py.Group) -> tuple[FloatArray, FloatArray]:
    """Lateral positions and depths, mm."""
    scan = require_group(group, "scan")
    kind = _class_of(scan)
    if kind != _LINEAR:
        raise InvalidInputError(
            f"{locate(scan)}: expected a {_LINEAR}, got {kind or 'none'}: beamform onto a {_LINEAR}, whose "
            "lines are parallel"
        )
    x, z = (flat(scan, name) for name in ("x_axis", "z_axis"))
    _require_order(scan, x, z)
    return 1e3 * x, 1e3 * z


def _require_order(scan: h5py.Group, x: FloatArray, z: FloatArray) -> None:
    """Refuse pixels in another order than USTB's, where the file lists their positions."""
    for name, expected in (("x", np.repeat(x, z.size)), ("z", np.tile(z, x.size))):
        if not has_member(scan, name):
            continue
        held = flat(scan, name)
        scale = float(np.abs(expected).max(initial=0.0)) or 1.0
        if held.shape != expected.shape or np.abs(held - expected).max(initial=0.0) > 1e-4 * scale:
            raise InvalidInputError(
                f"{locate(scan, name)}: expected those of {x.size} x {z.size} pixels, z fastest, got others"
            )


def _parts(group: h5py.Group) -> tuple[str, ...]:
    """Paths of the data sets that hold the data: one, or real and imaginary parts."""
    name = f"{group.name}/data".lstrip("/")
    if isinstance(find_member(group, "data"), h5py.Group):
        return f"{name}/real", f"{name}/imag"
    return (name,)


def _shape_of(group: h5py.Group, names: tuple[str, ...]) -> tuple[int, ...]:
    nodes = [require_dataset(group.file, name) for name in names]
    for node in nodes:
        if node.dtype.kind not in "fi" or node.shape != nodes[0].shape:
            raise InvalidInputError(
                f"{locate(node)}: expected numbers of shape {nodes[0].shape}, got {node.shape} {node.dtype}"
            )
    shape: tuple[int, ...] = nodes[0].shape
    return shape


def _layout(where: str, shape: tuple[int, ...], vectors: int, samples: int) -> tuple[int | None, int]:
    """Axis of the frames in the file, None where it has none, and their number.

    MATLAB leaves out axes of length 1 at its end, which is the beginning in the file; pyuff keeps MATLAB's
    order.
    """
    pixels = vectors * samples
    reverse = (
        len(shape) <= 4
        and shape[-1:] == (pixels,)
        and set(shape[1:-1] if len(shape) == 4 else shape[:-1]) <= {1}
    )
    forward = len(shape) <= 4 and shape[:1] == (pixels,) and set(shape[1:3]) <= {1}
    if reverse != forward or (reverse and len(shape) < 4):
        if len(shape) < 4:
            return None, 1
        axis = 0 if reverse else 3
        return axis, shape[axis]
    raise InvalidInputError(
        f"{where}: expected {pixels} pixels ({vectors} x {samples}) of one channel and one wave, summed, got "
        f"(MATLAB's order) {shape[::-1]}"
    )


def _pulse(group: h5py.Group, where: str, modulation_hz: float) -> dict[str, Found]:
    """Centre frequency, of the pulse or else what the data were shifted down by, and the pulse's band."""
    pulse = find_group(group, "pulse")
    centre = None if pulse is None else single(pulse, "center_frequency")
    share = None if pulse is None else single(pulse, "fractional_bandwidth")
    found = {}
    if centre:
        found["centre_frequency_hz"] = Found(centre, f"{where}/pulse/center_frequency")
    elif modulation_hz:
        found["centre_frequency_hz"] = Found(modulation_hz, f"assumed: {where}/modulation_frequency")
    if centre and share:
        band = (centre * (1.0 - share / 2.0), centre * (1.0 + share / 2.0))
        found["bandwidth_hz"] = Found(band, f"{where}/pulse/fractional_bandwidth")
    return found


def _speed(file: h5py.File) -> dict[str, Found]:
    """Speed of sound of the channel data in the same file, if there is one."""
    for name, kind in _objects(file).items():
        if kind == _CHANNELS:
            speed = single(require_group(file, name), "sound_speed")
            if speed:
                return {"speed_of_sound_m_s": Found(speed, f"{name}/sound_speed")}
    return {}


def _notes(file: h5py.File, group: h5py.Group) -> tuple[Row, ...]:
    rows: list[Row] = [("object", f"{name}: {kind}", "") for name, kind in _objects(file).items()]
    video = single(group, "frame_rate")
    if video is not None:
        rows.append(("frame rate of videos made of it, not used", f"{video:g}", "frames/s"))
    return tuple(rows)


def _contradictions(path: Path, settings: ImportSettings) -> list[str]:
    return _recording(path, settings).contradictions(settings)


READER = Reader(FORMAT, hdf5_claim(is_uff), read_uff, _describe, notes=_contradictions)
