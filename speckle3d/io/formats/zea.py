"""Recordings of zea, a toolbox of TU Eindhoven (HDF5) [1]_.

``/data``, or ``/tracks/NAME/data`` where several sequences were interleaved, holds what was recorded and
made of it; ``scan`` beside it says how. Of ``beamformed_data`` (frame, z, x, channel), one channel is RF and
two are I and Q; ``envelope_data`` (frame, z, x) are amplitudes; ``image`` (frame, z, x) is in decibels, or
grey levels of eight bits. Since version 0.0.12 each is a group of ``values`` and ``coordinates``, the
position (x, y, z) of each pixel in metres, by which the axes are told; before, a plain data set without
positions. ``metadata/probe_pose`` is the tracker: poses of the transducer's tip, in metres, on a clock
whose zero is the first transmission; its axes are x lateral, y elevational and z axial.

zea's I/Q come both ways, by version: shifted down by ``demodulation_frequency``, or carrying their frequency
again after delays were corrected. The phase of the data tells, see `hdf5_values`.

References
----------
.. [1] zea documentation, "Data", ``zea.data.spec``.
"""

from functools import partial
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.sweep import Tracker
from speckle3d.io.formats.hdf5_values import (
    TOLERANCE_MM,
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
    has_member,
    locate,
    read_array,
    read_text,
    read_texts,
    require_dataset,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.pose_paths import tracker_of
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Value

FORMAT = "zea"

_READ = ("beamformed_data", "envelope_data", "image_sc", "image")
_CHANNEL_DATA = ("raw_data", "aligned_data")
_POSES = "metadata/probe_pose"
_TIP_FROM_IMAGE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of the image (x lateral, y axial, z = x cross y) along zea's of the transducer's tip."""
_ROTATIONS = ("quaternion_wxyz", "quaternion_xyzw", "euler_xyz")


def is_zea(file: h5py.File) -> bool:
    """Whether an open file has zea's groups."""
    return any(Path(name).name in (*_READ, *_CHANNEL_DATA) for name in _members(file))


def _members(file: h5py.File) -> list[str]:
    """Members of the ``data`` groups: at the root, or of tracks."""

    def places(home: str) -> list[str]:
        node = find_member(file, home)
        return [f"{home}/{name}" for name in node] if isinstance(node, h5py.Group) else []

    homes = ["data", *(f"{track}/data" for track in places("tracks"))]
    return [place for home in homes for place in places(home) if has_member(file, place)]


def open_zea(file: h5py.File, settings: ImportSettings) -> Facts:
    """Read beamformed RF or I/Q, else an envelope, else images; with the probe's poses."""
    path, members = Path(file.filename), _members(file)
    contents = ", ".join(members)
    if any(name.endswith(_CHANNEL_DATA) for name in members):
        contents += ": channel data need beamforming, by zea's Pipeline, and its result written"
    yield "holds", contents, ""
    choice = settings.arrays.get("data", "").strip("/").removesuffix("/values")
    kinds = ([name for name in members if Path(name).name == kind and choice in ("", name)] for kind in _READ)
    names = next(filter(None, kinds), [])
    if len(names) != 1:
        raise InvalidInputError(
            f"expected one of {' or '.join(_READ)}, got {contents}: say which by arrays = {{ data = NAME }} "
            f"in {path.name}.toml beside it"
        )
    yield "read", names[0], ""
    group, kind = find_member(file, names[0]), Path(names[0]).name
    is_alone = len({Path(name).parent for name in members}) == 1
    home = names[0].removesuffix(f"data/{kind}")
    scan, has_channels = f"{home}scan", kind == "beamformed_data"
    has_places = has_member(group, "coordinates")
    node = group if isinstance(group, h5py.Dataset) else require_dataset(group, "values")
    sizes, channels = node.shape[:3], node.shape[3:]
    if len(sizes) < 3 or channels not in ([(1,), (2,)] if has_channels else [()]):
        raise InvalidInputError(
            f"{locate(node)}: expected echoes of shape (frame, z, x), of beamformed_data (frame, z, x, 1 or "
            f"2), got {node.shape} {node.dtype}"
        )
    places = {
        "speed_of_sound_m_s": f"{scan}/sound_speed",
        "centre_frequency_hz": f"{scan}/center_frequency",
        "bandwidth_hz": f"{scan}/bandwidth_percent",
    }
    values, left_mm, x_first = values_of(file, places), None, False
    if has_places:
        numbers, left_mm, x_first = _pixels(require_dataset(group, "coordinates"), sizes)
        values |= numbers
    lines, samples = sizes[1:] if x_first else sizes[:0:-1]
    shape, is_complex = (sizes[0], lines, samples), channels == (2,)
    turn = partial(frame_of, shape=shape[1:], across=not x_first, pairs=is_complex)
    source = HDF5Slices(path, (str(node.name),), turn)
    if has_channels or node.dtype == np.uint8:
        dtype = np.complex64 if is_complex else np.float32 if has_channels else np.uint8
        frames = FileFrames(path, source, shape, dtype)
    else:
        is_db, range_db = kind != "envelope_data", settings.dynamic_range_db
        frames, values["dynamic_range_db"] = grey_frames(source, shape, is_db, range_db)
    if is_complex and has_places and (shift_hz := single(file, f"{scan}/demodulation_frequency")):
        stated = Value(source="of scan/demodulation_frequency")
        values["demodulation_frequency_hz"] = by_phase(frames, shift_hz, stated, values, settings)
    try:
        tracker, remarks = _tracker(file, left_mm)
    except Speckle3DError as error:
        tracker, remarks = None, [f"the tracker is left out: {error}"]
    return Recording(
        path,
        settings,
        frames,
        values,
        time_s=_times(file, group, scan if is_alone else "", shape[0]),
        tracker=tracker,
        chain=_POSES,
        probe=settings.probe or read_text(file, "probe_name", read_text(file, "probe", "")),
        assumptions=() if has_places else ("parallel lines",),
        remarks=remarks,
    )


def _pixels(node: h5py.Dataset, shape: tuple[int, ...]) -> tuple[dict[str, Value], float | None, bool]:
    """Where the pixels of a Cartesian or polar grid lie, the same in all frames.

    Returns
    -------
    values : dict of str to Value
    left_mm : float or None
        Lateral place of the first of parallel lines; None of a fan's.
    x_first : bool
        Whether the first axis counts lines.
    """
    where = locate(node)
    if node.shape != (*shape, 3) or 0 in shape:
        raise InvalidInputError(f"{where}: expected shape {(*shape, 3)}, got {node.shape}")
    places_mm, end_mm = (1e3 * node[i].astype(np.float64) for i in (0, shape[0] - 1))
    is_fixed = (np.abs(end_mm - places_mm) <= TOLERANCE_MM).all()

    for x_first in (False, True):
        x, y, z = np.moveaxis(places_mm if x_first else places_mm.swapaxes(0, 1), 2, 0)
        values = pixel_values(z + 1j * x, where, "of the coordinates")
        if values is not None and np.ptp(y) <= TOLERANCE_MM and is_fixed:
            return values, float(x[0, 0]) if "vector_pitch_mm" in values else None, x_first
    raise InvalidInputError(
        f"{where}: expected pixels on a Cartesian or polar grid in one plane, the same in all frames, got "
        "others: beamform onto zea's cartesian_pixel_grid, or scan-convert them"
    )


def _times(file: h5py.File, group: h5py.Group, scan: str, count: int) -> FloatArray | None:
    """Time of each frame after the first transmission: of the data, or of the times between transmissions.

    Where one of a frame's is not known, the next frame has no time, and later ones count the median for it.
    """
    if has_member(group, "timestamps"):
        return np.asarray(
            read_array(group, "timestamps", (count,)) + (single(group, "start_time_offset") or 0)
        )
    name = f"{scan}/time_to_next_transmit"
    if not scan or not has_member(file, name):
        return None
    # The last transmission of all has no next one.
    lengths = read_array(file, name, (count, "transmission"))[:-1].sum(axis=1)
    is_finite = np.isfinite(lengths)
    if not is_finite.any():
        return None
    times = np.cumsum([0.0, *np.where(is_finite, lengths, np.median(lengths[is_finite]))])
    times[1:][~is_finite] = np.nan
    return times


def _tracker(file: h5py.File, left_mm: float | None) -> tuple[Tracker | None, list[str]]:
    """The probe's poses, with the image on the probe where the file says where its lines lie."""
    if (node := find_member(file, _POSES)) is None:
        return None, []
    word = "rotation_representation"
    kind = "".join(np.ravel(read_texts(node, word, None))) if has_member(node, word) else ""
    if kind not in _ROTATIONS:
        return None, [f"{_POSES}: not read: expected a {word} among {', '.join(_ROTATIONS)}"]
    is_euler, places_m = kind == "euler_xyz", read_array(node, "translation", ("pose", 3))
    rate, count = single(node, "sampling_frequency"), len(places_m)
    turns = read_array(node, "rotation", (count, 3 if is_euler else 4))
    stamps = np.arange(count) / rate if rate else read_array(node, "timestamps", (count,))
    if is_euler:
        rotations = Rotation.from_euler("xyz", turns)
    else:
        turns[~turns.any(axis=1)] = np.nan
        rotations = Rotation.from_quat(turns, scalar_first=kind == "quaternion_wxyz")
    matrices = RigidTransform.identity(count).as_matrix()
    matrices[:, :3, :3], matrices[:, :3, 3] = rotations.as_matrix(), 1e3 * places_m
    mounting = None
    if left_mm is not None:
        mounting = RigidTransform.from_components([left_mm, 0.0, 0.0], Rotation.from_matrix(_TIP_FROM_IMAGE))
    stamps += single(node, "start_time_offset") or 0.0
    tracker, notes = tracker_of(stamps, matrices, mounting)
    if is_euler:
        notes.append(f"{_POSES}: euler_xyz is taken for radians about fixed axes x, y, z: zea does not say")
    return tracker, notes


READER = Reader(FORMAT, None, open_zea, claims_hdf5=is_zea)
