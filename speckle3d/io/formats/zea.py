"""zea's HDF5 files, the format of the OpenH-RF data sets (zea documentation, "Data", ``zea.data.spec``).

``/data``, or ``/tracks/NAME/data`` where several sequences were interleaved, holds what was recorded and
made of it; ``scan`` beside it says how. Of ``beamformed_data`` (frame, z, x, channel), one channel is RF and
two are I and Q; ``envelope_data`` (frame, z, x) are amplitudes; ``image`` (frame, z, x) is in decibels, or
grey levels of eight bits. Since version 0.0.12 each is a group of ``values`` and ``coordinates``, the
position (x, y, z) of each pixel in metres, by which the axes are told; before, a plain data set without
positions.

zea's I/Q come both ways, by version: shifted down by ``demodulation_frequency``, or carrying their frequency
again after delays were corrected. The phase of the data tells, see `carrier`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Sweep
from speckle3d.io.carrier import demodulation_of
from speckle3d.io.formats.greys import grey_frames
from speckle3d.io.formats.hdf5_values import single
from speckle3d.io.formats.recordings import Recording, step_of
from speckle3d.io.found import Found
from speckle3d.io.hdf5 import (
    find_group,
    find_member,
    has_member,
    hdf5_claim,
    locate,
    open_hdf5,
    read_checked,
    read_text,
    reading,
    require_dataset,
    require_group,
)
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.lazy import HDF5Slices, Layout, Pairs, Real
from speckle3d.io.readers import Reader, Row

FORMAT = "zea"

_READ = ("beamformed_data", "envelope_data", "image", "image_sc")
_NOT_BEAMFORMED = ("raw_data", "aligned_data")
_MOST_TRACKS = 64
_FRAMES_CHECKED = 8
"""Whose pixels must lie where the first frame's do."""
_TOLERANCE_MM = 1e-3
"""Of a pixel's place: single precision in metres keeps 1e-5 mm of a depth of 150 mm."""


@dataclass(frozen=True)
class _Array:
    """Where the data lie.

    Attributes
    ----------
    name : str
        Data set, from the root.
    home : str
        Group that holds ``data`` and ``scan``: the root, or a track.
    kind : str
        One of `_READ`.
    coordinates : str, optional
        Data set of the pixels' positions.
    """

    name: str
    home: str
    kind: str
    coordinates: str | None


def read_zea(path: Path, settings: ImportSettings | None = None) -> Sweep:
    """Read beamformed RF or I/Q, else an envelope, else images; they stay on disk until asked for.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it holds channel data alone, or pixels that lie on no even grid.
    MissingSettingsError
        Naming all that the file does not say.
    """
    settings = settings or ImportSettings()
    return _recording(path, settings).sweep(settings)


def is_zea(file: h5py.File) -> bool:
    """Whether an open file has zea's groups, and no format of this package's family."""
    if "format" in file.attrs:
        return False
    homes = _homes(file)
    known = (*_READ, *_NOT_BEAMFORMED)
    return any(has_member(file, f"{home}data/{name}") for home in homes for name in known)


def _describe(path: Path, settings: ImportSettings) -> list[Row]:
    try:
        return _recording(path, settings).rows(settings)
    except InvalidInputError:
        # Why there is no sweep is told beside these rows.
        with reading(path), open_hdf5(path) as file:
            return _notes(file)


def _homes(file: h5py.File) -> list[str]:
    """Groups that hold ``data``: the root as an empty text, or tracks with a slash at the end."""
    if isinstance(find_member(file, "data"), h5py.Group):
        return [""]
    tracks = find_member(file, "tracks")
    if not isinstance(tracks, h5py.Group):
        return []
    return [
        f"tracks/{name}/"
        for name in sorted(each for each in tracks if isinstance(each, str))[:_MOST_TRACKS]
        if isinstance(find_member(tracks, f"{name}/data"), h5py.Group)
    ]


def _arrays(file: h5py.File) -> list[_Array]:
    """All that could be read."""
    found = []
    for home in _homes(file):
        for kind in _READ:
            member = find_member(file, f"{home}data/{kind}")
            name = f"{home}data/{kind}"
            if isinstance(member, h5py.Dataset):
                found.append(_Array(name, home, kind, None))
            elif isinstance(member, h5py.Group) and has_member(member, "values"):
                placed = has_member(member, "coordinates")
                found.append(_Array(f"{name}/values", home, kind, f"{name}/coordinates" if placed else None))
    return found


def _chosen(file: h5py.File, path: Path, settings: ImportSettings) -> _Array:
    """What to read: the earliest product, where not given by name."""
    arrays = _arrays(file)
    asked = settings.arrays.get("data")
    if asked is not None:
        arrays = [one for one in arrays if asked.strip("/") in (one.name, one.name.removesuffix("/values"))]
    elif all(one.coordinates is None for one in arrays) and any(one.kind == "image_sc" for one in arrays):
        # What came before scan conversion may be polar, and says nothing of it.
        arrays = [one for one in arrays if one.kind == "image_sc"]
    if not arrays:
        raise InvalidInputError(f"{path}: expected {' or '.join(_READ[:3])}, got {_held(file)}")
    first = min((one.kind for one in arrays), key=_READ.index)
    candidates = [one for one in arrays if one.kind == first]
    if len(candidates) > 1:
        listed = ", ".join(one.name for one in candidates)
        raise InvalidInputError(
            f"{path}: expected one track, got {listed}: say which by arrays = "
            f'{{ data = "{candidates[0].name}" }} in {path.name}.toml beside it'
        )
    return candidates[0]


def _held(file: h5py.File) -> str:
    names = [
        f"{home}data/{printable(name)}"
        for home in _homes(file)
        for name in require_group(file, f"{home}data")
        if isinstance(name, str)
    ]
    text = ", ".join(names) or "nothing"
    if any(name.endswith(_NOT_BEAMFORMED) for name in names):
        return f"{text}: channel data need beamforming, by zea's Pipeline, and its result written"
    if any(has_member(file, f"{name}/pixels") for name in names):
        return f"{text}: pixels with an extent, whose axes are not certain: write it by zea 0.0.12 or later"
    return text


def _recording(path: Path, settings: ImportSettings) -> Recording:
    with reading(path), open_hdf5(path) as file:
        array = _chosen(file, path, settings)
        node = require_dataset(file, array.name)
        count, first, second, channels = _shape(node, array)
        grid = None if array.coordinates is None else _grid(path, file, array, (count, first, second))
        found, times = _scan(file, array), _times(file, array, count)
        is_grey, trailing = node.dtype == np.uint8, node.shape[3:]
        notes, probe = tuple(_notes(file, array)), _probe(file)
    x_first = grid is not None and grid.x_first
    order = (0, 1) if x_first else (1, 0)
    shape = (count, first, second) if x_first else (count, second, first)
    layout = Layout((first, second, *(trailing if channels == 1 else ())), order)
    if channels == 2:
        frames = HDF5Slices(path, [array.name], 0, Pairs(layout), shape, np.complex64)
    elif array.kind == "beamformed_data" or is_grey:
        frames = HDF5Slices(path, [array.name], 0, Real(layout), shape, np.uint8 if is_grey else np.float32)
    else:
        decibels, given = array.kind != "envelope_data", settings.dynamic_range_db
        frames, top, span = grey_frames(path, [array.name], 0, layout, shape, decibels, given)
        found["dynamic_range_db"] = Found(span, f"of grey levels made here below {top:g}")
    if grid is None:
        notes += (("lines", "taken for parallel: the file does not say where pixels lie", ""),)
        return Recording(path, frames, found, time_s=times, probe=probe, notes=notes)
    found |= _placed(path, array, grid)
    spacing = float(found["row_spacing_mm"].value)
    if channels == 2:
        found["demodulation_frequency_hz"] = _demodulation(path, frames, found, settings, spacing)
    return Recording(path, frames, found, sample_spacing_mm=spacing, time_s=times, probe=probe, notes=notes)


def _shape(node: h5py.Dataset, array: _Array) -> tuple[int, int, int, int]:
    """Frames, the two axes of the image, and channels."""
    channelled = array.kind == "beamformed_data" and node.ndim == 4
    is_image = array.kind in ("image", "image_sc")
    sound = node.dtype.kind == "f" or (is_image and node.dtype == np.uint8)
    shaped = node.ndim == 3 or (channelled and node.shape[3] in (1, 2))
    if not sound or not shaped or 0 in node.shape:
        expected = "(frame, z, x, 1 or 2)" if array.kind == "beamformed_data" else "(frame, z, x)"
        raise InvalidInputError(
            f"{locate(node)}: expected echoes of shape {expected}, got {node.shape} {node.dtype}"
        )
    count, first, second = node.shape[:3]
    return count, first, second, node.shape[3] if channelled else 1


@dataclass(frozen=True)
class _Grid:
    """Lateral positions and depths of pixels, and whether the file's first axis of an image is lateral."""

    x_mm: FloatArray
    z_mm: FloatArray
    x_first: bool


def _grid(path: Path, file: h5py.File, array: _Array, shape: tuple[int, int, int]) -> _Grid:
    """Axes of the pixels, whose positions must be those of a Cartesian grid, the same in all frames."""
    assert array.coordinates is not None
    where = f"{path}: /{array.coordinates}"
    count, first, second = shape
    node = require_dataset(file, array.coordinates)
    if node.shape != (*shape, 3) or node.dtype.kind != "f":
        raise InvalidInputError(f"{where}: expected shape {(*shape, 3)}, got {node.shape} {node.dtype}")
    flat = Real(Layout((first * second, 3), (0, 1)))
    positions = HDF5Slices(path, [array.coordinates], 0, flat, (count, first * second, 3), np.float64)
    start = positions[0]
    for i in np.unique(np.linspace(0, count - 1, _FRAMES_CHECKED).astype(int)):
        if np.abs(positions[int(i)] - start).max() > _TOLERANCE_MM / 1e3:
            raise InvalidInputError(f"{where}[{i}]: expected pixels where the first frame's are, got others")
    positions.close()
    x, y, z = 1e3 * start.reshape(first, second, 3).transpose(2, 0, 1)
    for x_first in (False, True):
        columns, depths = (x.T, z.T) if x_first else (x, z)
        grid = _Grid(columns[0], depths[:, 0], x_first)
        off = max(np.abs(columns - grid.x_mm).max(), np.abs(depths.T - grid.z_mm).max(), np.ptp(y))
        if off <= _TOLERANCE_MM and np.ptp(grid.x_mm) > 0 and np.ptp(grid.z_mm) > 0:
            return grid
    raise InvalidInputError(
        f"{where}: expected pixels on a Cartesian grid in one plane, got others, as of a polar image: "
        "beamform onto zea's cartesian_pixel_grid, or scan-convert and write that"
    )


def _placed(path: Path, array: _Array, grid: _Grid) -> dict[str, Found]:
    pitch = step_of(grid.x_mm, f"{path}: /{array.coordinates} x")
    spacing = step_of(grid.z_mm, f"{path}: /{array.coordinates} z")
    return {
        "vector_pitch_mm": Found(pitch, "of the coordinates"),
        "column_pitch_mm": Found(pitch, "of the coordinates"),
        "row_spacing_mm": Found(spacing, "of the coordinates"),
        "first_sample_depth_mm": Found(float(grid.z_mm[0]), "of the coordinates"),
    }


def _scan(file: h5py.File, array: _Array) -> dict[str, Found]:
    """What ``scan`` says of the echoes; its sampling frequency is that of channel data."""
    scan = find_group(file, f"{array.home}scan")
    if scan is None:
        return {}
    found = {}
    for name, member in (("speed_of_sound_m_s", "sound_speed"), ("centre_frequency_hz", "center_frequency")):
        if value := single(scan, member):
            found[name] = Found(value, f"in {array.home}scan/{member}")
    percent, centre = single(scan, "bandwidth_percent"), found.get("centre_frequency_hz")
    if percent and centre is not None:
        half = centre.value * percent / 200.0
        band = (centre.value - half, centre.value + half)
        found["bandwidth_hz"] = Found(band, f"in {array.home}scan/bandwidth_percent")
    return found


def _demodulation(
    path: Path, frames: HDF5Slices, found: dict[str, Found], settings: ImportSettings, spacing_mm: float
) -> Found:
    """Frequency that I/Q were shifted down by, as their phase tells."""
    with reading(path), open_hdf5(path) as file:
        homes = _homes(file)
        named = [single(file, f"{home}scan/demodulation_frequency") for home in homes]
    middle = named[0] if len(set(named)) == 1 else None
    if settings.demodulation_frequency_hz is not None or not middle:
        return Found()
    speed = settings.speed_of_sound_m_s or found.get("speed_of_sound_m_s", Found(SPEED_OF_SOUND_M_S)).value
    with naming(str(path)):
        told = demodulation_of(frames, middle, 1e3 * speed / (2.0 * spacing_mm))
    frames.close()
    return Found(told, "of scan/demodulation_frequency and the phase of the data")


def _times(file: h5py.File, array: _Array, count: int) -> FloatArray | None:
    """Start of each frame, of the times between transmissions; None where the file has none."""
    name = f"{array.home}scan/time_to_next_transmit"
    if len(_homes(file)) > 1 or not has_member(file, name):
        return None
    steps = read_checked(file, name, (count, "transmission"))
    # The last transmission of all has no next one.
    last = steps[:-1].sum(axis=1)
    if not np.isfinite(last).all() or not (last > 0).all():
        raise InvalidInputError(f"{locate(file, name)}: expected times above 0, got others")
    return np.concatenate([[0.0], np.cumsum(last)])


def _probe(file: h5py.File) -> str:
    for name in ("probe_name", "probe"):
        if name in file.attrs:
            return printable(read_text(file, name))
    return ""


def _notes(file: h5py.File, array: _Array | None = None) -> list[Row]:
    rows: list[Row] = []
    for name, spoken in (("zea_version", "written by zea"), ("us_machine", "scanner")):
        if name in file.attrs:
            rows.append((spoken, printable(read_text(file, name)), ""))
    rows.append(("holds", _held(file), ""))
    if array is not None:
        rows.append(("read", array.name, ""))
    if has_member(file, "metadata/probe_pose"):
        rows.append(("probe's poses", "there, not read", ""))
    return rows


def _contradictions(path: Path, settings: ImportSettings) -> list[str]:
    return _recording(path, settings).contradictions(settings)


READER = Reader(FORMAT, hdf5_claim(is_zea), read_zea, _describe, notes=_contradictions)
