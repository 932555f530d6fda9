"""Recordings of zea, a toolbox of TU Eindhoven (HDF5) [1]_.

``/data``, or ``/tracks/NAME/data`` where several sequences were interleaved, holds what was recorded and
made of it; ``scan`` beside it says how. Of ``beamformed_data`` (frame, z, x, channel), one channel is RF and
two are I and Q; ``envelope_data`` (frame, z, x) are amplitudes; ``image`` (frame, z, x) is in decibels, or
grey levels of eight bits. Since version 0.0.12 each is a group of ``values`` and ``coordinates``, the
position (x, y, z) of each pixel in metres, by which the axes are told; before, a plain data set without
positions. ``metadata/probe_pose`` is the tracker: poses of the transducer's tip, in metres, on a clock
whose zero is the first transmission; its axes are x lateral, y elevational and z axial.

zea's I/Q come both ways, by version: shifted down by ``demodulation_frequency``, or carrying their frequency
again after delays were corrected. The phase of the data tells, see `carrier`.

References
----------
.. [1] zea documentation, "Data", ``zea.data.spec``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import Tracker
from speckle3d.io.carrier import demodulation_of
from speckle3d.io.formats.hdf5_values import Grid, HDF5File, dataset, single, text_attribute, text_of
from speckle3d.io.hdf5 import find_member, has_member, hdf5_claim, locate, open_hdf5, reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.pose_paths import timed_poses
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, speed_of, step_of

FORMAT = "zea"

_READ = ("beamformed_data", "envelope_data", "image", "image_sc")
_NOT_BEAMFORMED = ("raw_data", "aligned_data")
_POSES = "metadata/probe_pose"
_FRAMES_CHECKED = 8
"""Whose pixels must lie where the first frame's do."""
_TOLERANCE_MM = 1e-3
"""Of a pixel's place: single precision in metres keeps 1e-5 mm of a depth of 150 mm."""
_TIP_FROM_IMAGE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of the image (x lateral, y axial, z = x cross y) along zea's of the transducer's tip."""
_ROTATIONS = ("quaternion_wxyz", "quaternion_xyzw", "euler_xyz")


@dataclass(frozen=True)
class _Array:
    """Where the data lie.

    Attributes
    ----------
    name : str
        Data set, from the root.
    home : str
        What stands before ``data`` and ``scan``: nothing at the root, or a track.
    kind : str
        One of `_READ`.
    is_placed : bool
        Whether ``coordinates`` beside the values say where pixels lie.
    """

    name: str
    home: str
    kind: str
    is_placed: bool = False

    @property
    def group(self) -> str:
        """What holds the values, their coordinates and their times."""
        return self.name.removesuffix("/values")


@dataclass(frozen=True)
class _Pixels:
    """Lateral positions and depths of pixels, and whether the file's first axis of an image is lateral."""

    x_mm: FloatArray
    z_mm: FloatArray
    x_first: bool


def is_zea(file: h5py.File) -> bool:
    """Whether an open file has zea's groups, and no format of this package's family."""
    names = (*_READ, *_NOT_BEAMFORMED)
    return "format" not in file.attrs and any(
        find_member(file, f"{home}data/{name}") is not None for home in _homes(file) for name in names
    )


def open_zea(path: Path, settings: ImportSettings) -> Recording:
    """Read beamformed RF or I/Q, else an envelope, else images; with the probe's poses."""
    with reading(path), open_hdf5(path) as file:
        facts = {"zea_version": "written by zea", "us_machine": "scanner"}
        rows: list[Row] = [(words, text_attribute(file, name), "") for name, words in facts.items()]
        rows = [*filter(lambda row: row[1], rows), ("holds", _contents(file), "")]
        return Recording.of(path, settings, rows, lambda: _recording(path, settings, file, rows))


def _recording(path: Path, settings: ImportSettings, file: h5py.File, rows: list[Row]) -> Recording:
    array = _chosen(file, path, settings)
    rows.append(("read", array.name, ""))
    node = dataset(file, array.name)
    count, first, second, channels = _shape(node, array)
    pixels = _pixels(dataset(file, f"{array.group}/coordinates"), node.shape[:3]) if array.is_placed else None
    x_first = pixels is not None and pixels.x_first
    shape = (count, first, second) if x_first else (count, second, first)
    trailing = node.shape[3:] if channels == 1 else ()
    grid = Grid((first, second, *trailing), (0, 1) if x_first else (1, 0), channels == 2)
    source, values = HDF5File(path, (array.name,), 0, grid), _scan(file, array)
    if array.kind == "beamformed_data" or node.dtype == np.uint8:
        dtype = np.complex64 if channels == 2 else np.uint8 if node.dtype == np.uint8 else np.float32
        frames = source.frames(shape, dtype)
    else:
        decibels, given = array.kind != "envelope_data", settings.dynamic_range_db
        frames, top, span = source.grey_frames(shape, grid, decibels, given)
        values["dynamic_range_db"] = Value(span, f"of grey levels made here below {top:g}")
    spacing = None
    if pixels is not None:
        where, source_text = locate(file, f"{array.group}/coordinates"), "of the coordinates"
        pitch = Value(step_of(pixels.x_mm, f"{where} x"), source_text)
        spacing = step_of(pixels.z_mm, f"{where} z")
        values |= {
            "vector_pitch_mm": pitch,
            "column_pitch_mm": pitch,
            "row_spacing_mm": Value(spacing, source_text),
            "first_sample_depth_mm": Value(float(pixels.z_mm[0]), source_text),
        }
        shifts = {single(file, f"{home}scan/demodulation_frequency") for home in _homes(file)}
        shift_hz = shifts.pop() if len(shifts) == 1 else None
        if channels == 2 and shift_hz and settings.demodulation_frequency_hz is None:
            with naming(str(path)):
                by_phase = demodulation_of(frames, shift_hz, 1e3 * speed_of(settings, values) / (2 * spacing))
            source_text = "of scan/demodulation_frequency and the phase of the data"
            values["demodulation_frequency_hz"] = Value(by_phase, source_text)
    tracker, remarks = _tracker(file, pixels)
    return Recording(
        path,
        settings,
        frames,
        values,
        sample_spacing_mm=spacing,
        time_s=_times(file, array, count),
        tracker=tracker,
        chain=_POSES,
        probe=settings.probe or text_attribute(file, "probe_name") or text_attribute(file, "probe"),
        assumptions=() if pixels is not None else ("parallel lines",),
        remarks=tuple(remarks),
    )


def _homes(file: h5py.File) -> list[str]:
    """What stands before ``data``: nothing at the root, or tracks with a slash at the end."""
    tracks = find_member(file, "tracks")
    names = sorted(map(str, tracks)) if isinstance(tracks, h5py.Group) else []
    homes = ["", *(f"tracks/{name}/" for name in names)]
    homes = [home for home in homes if isinstance(find_member(file, f"{home}data"), h5py.Group)]
    return homes[:1] if homes[:1] == [""] else homes


def _arrays(file: h5py.File) -> list[_Array]:
    """All that could be read."""
    arrays = []
    for home in _homes(file):
        for kind in _READ:
            name = f"{home}data/{kind}"
            if isinstance(find_member(file, name), h5py.Dataset):
                arrays.append(_Array(name, home, kind))
            elif has_member(file, f"{name}/values"):
                is_placed = has_member(file, f"{name}/coordinates")
                arrays.append(_Array(f"{name}/values", home, kind, is_placed))
    return arrays


def _chosen(file: h5py.File, path: Path, settings: ImportSettings) -> _Array:
    """What to read: the earliest product, where not given by name."""
    arrays = _arrays(file)
    asked = settings.arrays.get("data")
    if asked is not None:
        arrays = [one for one in arrays if asked.strip("/") in (one.name, one.group)]
    elif not any(one.is_placed for one in arrays):
        # What came before scan conversion may be polar, and says nothing of it.
        arrays = [one for one in arrays if one.kind == "image_sc"] or arrays
    if not arrays:
        raise InvalidInputError(f"{path}: expected {' or '.join(_READ[:3])}, got {_contents(file)}")
    first = min((one.kind for one in arrays), key=_READ.index)
    names = [one.name for one in arrays if one.kind == first]
    if len(names) > 1:
        raise InvalidInputError(
            f"{path}: expected one track, got {', '.join(names)}: say which by arrays = "
            f'{{ data = "{names[0]}" }} in {path.name}.toml beside it'
        )
    return next(one for one in arrays if one.kind == first)


def _contents(file: h5py.File) -> str:
    names = [f"{home}data/{printable(str(name))}" for home in _homes(file) for name in file[f"{home}data"]]
    text = ", ".join(names) or "nothing"
    if any(name.endswith(_NOT_BEAMFORMED) for name in names):
        return f"{text}: channel data need beamforming, by zea's Pipeline, and its result written"
    if any(find_member(file, f"{name}/pixels") is not None for name in names):
        return f"{text}: pixels with an extent, whose axes are not certain: write it by zea 0.0.12 or later"
    return text


def _shape(node: h5py.Dataset, array: _Array) -> tuple[int, int, int, int]:
    """Frames, the two axes of the image, and channels."""
    is_beamformed = array.kind == "beamformed_data"
    is_number = node.dtype.kind == "f" or (array.kind.startswith("image") and node.dtype == np.uint8)
    channels = node.shape[3] if is_beamformed and node.ndim == 4 else 1
    if not is_number or node.ndim != 3 + (is_beamformed and node.ndim == 4) or channels not in (1, 2):
        expected = "(frame, z, x, 1 or 2)" if is_beamformed else "(frame, z, x)"
        raise InvalidInputError(
            f"{locate(node)}: expected echoes of shape {expected}, got {node.shape} {node.dtype}"
        )
    return *node.shape[:3], channels


def _pixels(node: h5py.Dataset, shape: tuple[int, ...]) -> _Pixels:
    """Axes of the pixels, whose positions must be those of a Cartesian grid, the same in all frames."""
    where = locate(node)
    if node.shape != (*shape, 3) or node.dtype.kind != "f" or not shape[0]:
        raise InvalidInputError(f"{where}: expected shape {(*shape, 3)}, got {node.shape} {node.dtype}")
    start = np.asarray(node[0], dtype=np.float64)
    for i in np.unique(np.linspace(0, shape[0] - 1, _FRAMES_CHECKED).astype(int)).tolist():
        if not np.abs(node[i] - start).max() <= _TOLERANCE_MM / 1e3:
            raise InvalidInputError(f"{where}[{i}]: expected pixels where the first frame's are, got others")
    x, y, z = 1e3 * start.transpose(2, 0, 1)
    for x_first in (False, True):
        columns, depths = (x.T, z.T) if x_first else (x, z)
        pixels = _Pixels(columns[0], depths[:, 0], x_first)
        off = max(np.abs(columns - pixels.x_mm).max(), np.abs(depths.T - pixels.z_mm).max(), np.ptp(y))
        if off <= _TOLERANCE_MM and np.ptp(pixels.x_mm) > 0 and np.ptp(pixels.z_mm) > 0:
            return pixels
    raise InvalidInputError(
        f"{where}: expected pixels on a Cartesian grid in one plane, got others, as of a polar image: "
        "beamform onto zea's cartesian_pixel_grid, or scan-convert and write that"
    )


def _scan(file: h5py.File, array: _Array) -> dict[str, Value]:
    """What ``scan`` says of the echoes; its sampling frequency is that of channel data."""
    values, home = {}, f"{array.home}scan"
    for name, field in (("speed_of_sound_m_s", "sound_speed"), ("centre_frequency_hz", "center_frequency")):
        if value := single(file, f"{home}/{field}"):
            values[name] = Value(value, f"in {home}/{field}")
    percent, centre = single(file, f"{home}/bandwidth_percent"), values.get("centre_frequency_hz")
    if percent and centre is not None:
        half = centre.value * percent / 200.0
        band = (centre.value - half, centre.value + half)
        values["bandwidth_hz"] = Value(band, f"in {home}/bandwidth_percent")
    return values


def _times(file: h5py.File, array: _Array, count: int) -> FloatArray | None:
    """Time of each frame after the first transmission: of the data, or of the times between transmissions.

    Where one of a frame's is not known, the next frame has no time, and later ones count the median for it.
    """
    group, name = array.group, f"{array.home}scan/time_to_next_transmit"
    if array.name != group and has_member(file, f"{group}/timestamps"):
        stamps = np.asarray(dataset(file, f"{group}/timestamps")[()], dtype=np.float64)
        if stamps.shape == (count,):
            return stamps + (single(file, f"{group}/start_time_offset") or 0.0)
    if len(_homes(file)) > 1 or not has_member(file, name):
        return None
    steps = np.asarray(dataset(file, name)[()], dtype=np.float64)
    if steps.ndim != 2 or len(steps) != count:
        raise InvalidInputError(f"{locate(file, name)}: expected {count} rows, got shape {steps.shape}")
    # The last transmission of all has no next one.
    lengths = steps[:-1].sum(axis=1)
    known = np.isfinite(lengths)
    if not known.any():
        return None
    times = np.cumsum([0.0, *np.where(known, lengths, np.median(lengths[known]))])
    times[1:][~known] = np.nan
    return times


def _tracker(file: h5py.File, pixels: _Pixels | None) -> tuple[Tracker | None, list[str]]:
    """The probe's poses, with the image on the probe where the file says where its pixels lie."""
    node = find_member(file, _POSES)
    if node is None:
        return None, []
    name = f"{_POSES}/rotation_representation"
    kind = text_of(file[name][()]) if isinstance(find_member(file, name), h5py.Dataset) else ""
    if kind not in _ROTATIONS:
        return None, [f"{_POSES}: not read: expected a rotation_representation among {', '.join(_ROTATIONS)}"]
    places, turns = (np.asarray(dataset(node, name)[()], float) for name in ("translation", "rotation"))
    rate, count = single(node, "sampling_frequency"), len(places)
    stamps = np.arange(count) / rate if rate else np.asarray(dataset(node, "timestamps")[()], dtype=float)
    if places.shape != (count, 3) or turns.shape != (count, 3 if kind == "euler_xyz" else 4):
        raise InvalidInputError(
            f"{locate(node)}: expected as many translations as rotations ({kind}), got shapes "
            f"{places.shape} and {turns.shape}"
        )
    matrices = np.full((count, 4, 4), np.nan)
    matrices[:, :3, 3], matrices[:, 3] = 1e3 * places, [0.0, 0.0, 0.0, 1.0]
    sound = np.isfinite(turns).all(axis=1) & (turns.any(axis=1) | (kind == "euler_xyz"))
    remarks = []
    if kind == "euler_xyz":
        turned = Rotation.from_euler("xyz", turns[sound])
        remarks.append(f"{_POSES}: euler_xyz is taken for radians about fixed axes x, y, z: zea does not say")
    else:
        turned = Rotation.from_quat(turns[sound], scalar_first=kind == "quaternion_wxyz")
    matrices[sound, :3, :3] = turned.as_matrix()
    readings, notes = timed_poses(stamps + (single(node, "start_time_offset") or 0.0), matrices)
    if readings is None:
        return None, [*notes, f"{_POSES}: no pose is of use"]
    mounting = None
    if pixels is not None:
        place = [float(pixels.x_mm[0]), 0.0, 0.0]
        mounting = RigidTransform.from_components(place, Rotation.from_matrix(_TIP_FROM_IMAGE))
    return Tracker(readings, mounting), [*notes, *remarks]


READER = Reader(FORMAT, hdf5_claim(is_zea), open_zea)
