"""Beamformed data in the ultrasound file format of USTB, the UltraSound ToolBox (``.uff``, HDF5) [1]_.

Every object is a group whose attribute ``class`` names it. Of ``uff.beamformed_data`` are read ``data``, of
pixels, channels, waves and frames, which MATLAB writes with its first index running fastest, so that HDF5
shows the axes in reverse; ``scan``, a ``uff.linear_scan`` with ``x_axis`` and ``z_axis`` in metres, of which
z runs fastest over the pixels; ``modulation_frequency`` in Hz, by which complex data were shifted down, and
0 where they were not; and ``pulse``, with ``center_frequency`` in Hz and ``fractional_bandwidth`` as a share
of it. Complex data are a group of ``real`` and ``imag``.

``frame_rate`` is that of videos to be made of the data, 1 unless set: it is not used.

References
----------
.. [1] A. Rodriguez-Molares et al., "The UltraSound ToolBox", IEEE Int. Ultrasonics Symp., 2017.
"""

from functools import partial
from pathlib import Path

import h5py
import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.formats.hdf5_values import (
    by_phase,
    frame_of,
    grey_frames,
    pixel_values,
    single,
    values_of,
)
from speckle3d.io.frames import FileFrames, HDF5Slices
from speckle3d.io.hdf5 import (
    find_member,
    locate,
    read_array,
    read_text,
    require_dataset,
    require_group,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Value

FORMAT = "USTB .uff"

_IMAGE_CLASS, _CHANNEL_CLASS = "uff.beamformed_data", "uff.channel_data"
_LINEAR, _SECTOR = "uff.linear_scan", "uff.sector_scan"


def is_uff(file: h5py.File) -> bool:
    """Whether an open file holds objects of USTB."""
    return any(kind.startswith("uff.") for kind in _objects(file).values())


def _objects(file: h5py.File) -> dict[str, str]:
    """Classes of the root's groups, by their names."""
    nodes = {str(name): find_member(file, name) for name in file}
    kinds = {name: read_text(node, "class", "") for name, node in nodes.items() if node is not None}
    return {name: kind for name, kind in kinds.items() if kind}


def open_uff(file: h5py.File, settings: ImportSettings) -> Facts:
    """Read beamformed RF or I/Q on a linear or a sector scan; real data of one sign become grey levels."""
    path, choice, objects = Path(file.filename), settings.arrays.get("data"), _objects(file)
    yield from (("object", f"{name}: {kind}", "") for name, kind in objects.items())
    names = [name for name, kind in objects.items() if kind == _IMAGE_CLASS and choice in (None, name)]
    if len(names) != 1:
        candidates = ", ".join(names or objects.values()) or "none"
        raise InvalidInputError(
            f"expected one {_IMAGE_CLASS}, got {candidates}: say which by arrays = {{ data = NAME }} in "
            f"{path.name}.toml beside it, or beamform channels by USTB's das on a {_LINEAR}"
        )
    name = names[0]
    group, data = require_group(file, name), f"{name}/data"
    lines, samples, values = _scan(group, f"in {name}/scan")
    is_complex = isinstance(find_member(file, data), h5py.Group)
    parts = (f"{data}/real", f"{data}/imag") if is_complex else (data,)
    axis, count = _frame_axis(require_dataset(file, parts[0]), lines * samples)
    modulation_hz = single(group, "modulation_frequency") or 0.0
    modulation = Value(modulation_hz, f"in {name}/modulation_frequency")
    values["demodulation_frequency_hz"] = modulation
    if modulation_hz:
        values["centre_frequency_hz"] = Value(modulation_hz, f"assumed: {name}/modulation_frequency")
    pulse = {"centre_frequency_hz": "pulse/center_frequency", "bandwidth_hz": "pulse/fractional_bandwidth"}
    values |= values_of(group, pulse)
    for channels, kind in objects.items():
        if kind == _CHANNEL_CLASS:
            values |= values_of(file, {"speed_of_sound_m_s": f"{channels}/sound_speed"})
    shape = count, lines, samples
    source = HDF5Slices(path, parts, partial(frame_of, shape=shape[1:]), axis)
    frames = FileFrames(path, source, shape, np.complex64 if is_complex else np.float32)
    if not is_complex:
        # Echoes have both signs, amplitudes and decibels one.
        frame = frames[count // 2]
        is_db = bool(frame.min() < 0)
        if not is_db or frame.max() <= 0:
            frames, values["dynamic_range_db"] = grey_frames(source, shape, is_db, settings.dynamic_range_db)
            yield "data", f"of one sign: {'decibels' if is_db else 'an envelope'}, made grey levels here", ""
    elif "centre_frequency_hz" in values:
        carrier_hz = modulation_hz or values["centre_frequency_hz"].value
        values["demodulation_frequency_hz"] = by_phase(frames, carrier_hz, modulation, values, settings)
    return Recording(path, settings, frames, values)


def _scan(group: h5py.Group, source: str) -> tuple[int, int, dict[str, Value]]:
    """Lines and samples of a scan, and where they lie."""
    scan, where = require_group(group, "scan"), locate(group, "scan")
    kind = read_text(scan, "class", "")

    def axis(name: str) -> FloatArray:
        return read_array(scan, name, None).ravel()

    place = np.zeros((0, 0), dtype=complex)
    if kind == _SECTOR:
        # Depths are from where the lines meet, which is above the array's face if it is curved.
        place = 1e3 * axis("depth_axis") * np.exp(1j * axis("azimuth_axis")[:, None])
        place += 1e3 * axis("z")[0] - place[0, 0].real
    elif kind == _LINEAR:
        place = 1e3 * (axis("z_axis") + 1j * axis("x_axis")[:, None])
    values = pixel_values(place, where, source) if kind in (_LINEAR, _SECTOR) else None
    if values is None:
        raise InvalidInputError(
            f"{where}: expected a {_LINEAR} or {_SECTOR}, got {kind or 'none'}: beamform onto one of them"
        )
    return *place.shape, values


def _frame_axis(node: h5py.Dataset, pixels: int) -> tuple[int | None, int]:
    """Axis of the frames in the file, None where it has none, and their number.

    MATLAB leaves out axes of length 1 at its end, which is the beginning in the file; pyuff keeps MATLAB's
    order.
    """
    shape = node.shape
    axis = (0 if shape[-1] == pixels else 3) if len(shape) == 4 else None
    count = 1 if axis is None else shape[axis]
    if node.size != count * pixels:
        raise InvalidInputError(
            f"{locate(node)}: expected {pixels} pixels of one channel and one wave, summed, got (MATLAB's "
            f"order) {shape[::-1]}"
        )
    return axis, count


READER = Reader(FORMAT, None, open_uff, claims_hdf5=is_uff)
