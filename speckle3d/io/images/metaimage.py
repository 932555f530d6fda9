"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import reading
from speckle3d.io.images.header_fields import is_image
from speckle3d.io.images.headers import SequenceHeader, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.device_set import DeviceSet, read_device_set
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    Names,
    Poses,
    ends,
    fixed_transform,
    names_of,
    pixel_axes,
    sensor_from_image,
    tracked_poses,
)
from speckle3d.io.plus.write import own_values
from speckle3d.io.pose_paths import timed_poses
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import CONTRADICTION, Facts, Recording, Value, differs

_DEVICE, _PIXELS = "the device set", ("column_pitch_mm", "row_spacing_mm")


def read_poses(path: PathLike, settings: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    settings = settings or ImportSettings()
    with reading(path):  # of more frames than memory has places for
        header = read_header(path)
        readings, notes = _readings(header, settings, _poses(header, settings, _device_set(settings)))
    if readings is None:
        raise InvalidInputError(
            f"{path}: expected tracked poses (fields like ProbeToTrackerTransform), got {lacking_poses(path)}"
        )
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return Tracker(readings)


def lacking_poses(path: PathLike) -> str:
    """Say which transforms an image sequence holds, if not those of the usual names."""
    names = names_of(read_header(path))
    return f"{', '.join(names)}: name the sensor's with --transform" if names else "none"


def open_sequence(path: Path, settings: ImportSettings) -> Facts:
    """Read what a header says of its images and poses; the frames stay on disk.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose image status is not OK are left out.

    Raises
    ------
    FileError, InvalidInputError
        If it, or the device set beside it, cannot be read or does not make sense.
    """
    header, device = read_header(path), _device_set(settings)
    layout = Layout.of(header, device.text("PortUsImageOrientation") or None)
    yield "container", header.container, ""
    yield "size", _length_text(header.size) if header.has_images else "no images", ""
    kinds = {"UltrasoundImageType": layout.kind, "UltrasoundImageOrientation": layout.orientation}
    for name, word in kinds.items() if header.has_images else ():
        words = name.removeprefix("Ultrasound").replace("Image", "image ").lower()
        yield words, word if name in header.fields else f"{word} (assumed)", ""
    yield "transforms", ", ".join(names_of(header)) or "none", ""
    _require_images(header, layout, settings)
    own, poses = own_values(header.path, header.fields), _poses(header, settings, device)
    calibration = _calibration(header, settings, device, layout, poses)
    readings, remarks = _readings(header, settings, poses)
    chain, substitutes = "", dict[str, str]()
    if poses is not None:
        has_mounting = calibration.value is not None and poses.pixels is None
        mounting = [f"{device.names.image}To{poses.tool}"] if has_mounting else []
        chain = " * ".join([*mounting, *poses.chain])
        name = f"{device.names.image}To{ends(poses.chain[-1])[1]}"
        if calibration.value is None and name in names_of(header):
            substitutes = dict.fromkeys(_PIXELS, "tracker_transform")
            remarks.append(f"no place of the image on the tool: --transform {name} takes the file's own")
        elif has_mounting and name in names_of(header):
            direct = tracked_poses(header, name, "none", device.names)
            if direct and (off_mm := _misplacement_mm(header, poses, calibration, direct)):
                words = f"{chain}, which is used: --transform {name} takes the other"
                remarks.append(f"{name} places images up to {off_mm:.3g} mm away from {words}")
    elif names_of(header) and settings.tracker_transform is None:
        remarks.append(f"no tracker: the header's transforms are {lacking_poses(path)}")
    first_mm = settings.first_sample_depth_mm
    if first_mm is None:
        first_mm = own.get("first_sample_depth_mm", 0.0)
    own_numbers = {name: Value(number, "as this package wrote it") for name, number in own.items()}
    return Recording(
        path,
        settings,
        _file_frames(header, layout),
        _values(header, device, layout, calibration) | own_numbers,
        time_s=_times(header),
        faults=_image_faults(header),
        tracker=_tracker(readings, calibration, first_mm, f"{path}: {calibration.source}"),
        orientation=_orientation(header, settings),
        chain=chain,
        probe=settings.probe or own.get("probe") or device.text("TransducerName"),
        full_scale=own.get("full_scale", 255.0),
        substitutes=substitutes,
        assumptions=("parallel lines",) if layout.is_rf and not own else (),
        remarks=(*remarks, *_contradictions(header, device, layout, Value() if own else calibration)),
    )


def _misplacement_mm(header: SequenceHeader, poses: Poses, calibration: Value, direct: Poses) -> float:
    """Distance of an image's corners by the file's own transform from those by the chain; 0 where alike."""
    corners = np.array([[0.0, 0.0, 0.0, 1.0], [*header.size[:2], 0.0, 1.0]]).T
    used = poses.matrices @ calibration.value @ corners
    other = direct.matrices @ (np.eye(4) if direct.pixels is None else direct.pixels) @ corners
    is_valid = [not (a or b) for a, b in zip(poses.faults, direct.faults, strict=True)]
    off_mm = float(np.linalg.norm(used - other, axis=1)[is_valid].max(initial=0.0))
    return off_mm if off_mm > CONTRADICTION * np.linalg.norm(np.diff(used)[0]) else 0.0


def _device_set(settings: ImportSettings) -> DeviceSet:
    return DeviceSet() if settings.plus_config is None else read_device_set(settings.plus_config)


def _poses(header: SequenceHeader, settings: ImportSettings, device: DeviceSet) -> Poses | None:
    """Poses of the tracked tool."""
    return tracked_poses(header, settings.tracker_transform, settings.reference_transform, device.names)


def _calibration(
    header: SequenceHeader,
    settings: ImportSettings,
    device: DeviceSet,
    layout: Layout,
    poses: Poses | None,
) -> Value:
    """Transform of this image's pixels to mm on the tracked tool."""
    image, tool = device.names.image, device.names.probe if poses is None else poses.tool
    if (matrix := settings.image_to_probe) is not None:
        return Value(np.reshape(matrix, (4, 4)), "image_to_probe", "image_to_probe")
    if poses is not None and poses.pixels is not None:
        return Value(poses.pixels, f"{poses.chain[0]}Transform")
    for name in (f"{image}To{tool}", "Calibration"):  # the second is of Ibis
        if (transform := fixed_transform(header, name)) is not None:
            return Value(transform, f"{name}Transform")
    # The device set's is for the image that the machine shows, not for the lines it was made of.
    transform = None if layout.is_rf else device.transform(image, tool)
    return Value(transform, f"{image}To{tool}", _DEVICE)


def _require_images(header: SequenceHeader, layout: Layout, settings: ImportSettings) -> None:
    """Raise unless these are ultrasound images and the file is long enough for them."""
    if not header.has_images:
        use = f"a tracker's recording of {header.frame_count} frames, for --poses"
        raise InvalidInputError(f"expected pixels of images, got {use if names_of(header) else 'none'}")
    if header.is_volume and not settings.frame_rate_hz:
        raise InvalidInputError(
            "expected a sequence of images, got a volume, whose third axis is in space by its Kinds; if it "
            "is time, say so by --frame-rate-hz"
        )
    layout.require_lines(header)
    if header.encoding == "raw":  # of packed ones the number shows when they are unpacked
        header.numbers()


def _readings(
    header: SequenceHeader, settings: ImportSettings, poses: Poses | None
) -> tuple[TimedPoses | None, list[str]]:
    """Poses that have a time, and a line of those left out."""
    rate_hz = settings.frame_rate_hz
    times = _times(header) if rate_hz is None else np.arange(header.frame_count) / rate_hz
    if poses is None or times is None:
        return None, []
    return timed_poses(times, poses.matrices, poses.faults)


def _tracker(readings: TimedPoses | None, calibration: Value, first_mm: float, where: str) -> Tracker | None:
    """The tracker, with the image's place on it."""
    if readings is None or calibration.value is None:
        return None if readings is None else Tracker(readings)
    place, skew_rad = sensor_from_image(calibration.value, first_mm, where)
    return Tracker(readings, place, image_skew_rad=skew_rad)


def _times(header: SequenceHeader) -> FloatArray | None:
    """Time of each frame by its stamp or its axis, NaN where it has none.

    Stamps all the same are none.
    """
    stamps = header.values("Timestamp", 1)[:, 0]
    is_clock = np.unique(stamps[np.isfinite(stamps)]).size >= min(2, stamps.size)
    return stamps if is_clock else header.axis_times_s


def _image_faults(header: SequenceHeader) -> list[str]:
    """Why each image is of no use; older files of PLUS tell it in Status alone."""
    statuses = dict(header.column("Status")) | dict(header.column("ImageStatus"))
    is_valid = (statuses.get(i, "OK") == "OK" for i in range(header.frame_count))
    return ["" if valid else "not valid by their status" for valid in is_valid]


def _spacing_mm(header: SequenceHeader, layout: Layout) -> tuple[float, ...] | None:
    """Distances of columns and rows by the header."""
    spacing = header.spacing_mm
    return spacing[::-1] if spacing and layout.has_lines_in_rows else spacing


def _pixel_mm(header: SequenceHeader, calibration: Value) -> Value:
    """Distances of columns and rows on the tracked tool."""
    if calibration.value is None:
        return calibration
    where = f"{header.path}: {calibration.source}"
    return replace(calibration, value=pixel_axes(calibration.value, where))


def _values(
    header: SequenceHeader, device: DeviceSet, layout: Layout, calibration: Value
) -> dict[str, Value]:
    """Numbers that a sweep of this kind needs, with their sources."""
    # The sampling rate of RF is known better than by a calibration.
    sizes = [Value(_spacing_mm(header, layout), "ElementSpacing")]
    if not layout.is_rf:
        machine = Value(device.pixel_mm(header.size), "device set", _DEVICE)
        sizes = [_pixel_mm(header, calibration), *sizes, machine]
    pixel = next((size for size in sizes if size.value is not None), Value())
    across, down = (replace(pixel, value=size) for size in pixel.value or (None, None))
    values, (vectors, samples) = dict[str, Value](), layout.shape(header.size)

    scan = partial(Value, source="ScanConversion of the device set", said_by=_DEVICE)
    width_mm = device.scan("TransducerWidthMm")
    if device.is_curved and (layout.is_rf or layout.has_lines_in_rows):
        near, far = device.scan("RadiusStartMm", "RadiusStopMm") or (None, 0.0)
        angles = device.scan("ThetaStartDeg", "ThetaStopDeg")
        values |= {"line_angles_deg": scan(angles), "array_radius_mm": scan(near)}
        if near is not None and samples > 1:
            values["row_spacing_mm"] = scan((far - near) / (samples - 1))
    elif not layout.is_rf or down.value is not None:
        values |= {f"{'vector' if layout.is_rf else 'column'}_pitch_mm": across, "row_spacing_mm": down}
    elif width_mm is not None:
        values["vector_pitch_mm"] = scan(width_mm[0] / vectors)
    return values


def _orientation(header: SequenceHeader, settings: ImportSettings) -> OrientationSensor | None:
    """The orientation sensor, as this package writes it."""
    name = f"{ORIENTATION}ToWorld"
    if name not in names_of(header):
        return None
    readings, _ = _readings(header, settings, tracked_poses(header, name, "none", Names()))
    if readings is None:
        return None
    matrix = fixed_transform(header, f"{IMAGE}To{ORIENTATION}")
    mounting = None if matrix is None else sensor_from_image(matrix, 0.0, header.path)[0].rotation
    rotations = readings.world_from_sensor.rotation
    return OrientationSensor(TimedRotations(readings.time_s, rotations), mounting)


def _contradictions(
    header: SequenceHeader, device: DeviceSet, layout: Layout, calibration: Value
) -> Iterator[str]:
    """Tell what contradicts in header, device set and calibration."""
    size, spacing = _pixel_mm(header, calibration), _spacing_mm(header, layout)
    if size.value and spacing and differs(size.value, spacing):
        text = f"{_length_text(size.value)} mm, {size.source}"
        yield f"pixels of {text}: the file says {_length_text(spacing)}"
    if " -" in f" {header.fields.get('ElementSpacing')}":
        yield "ElementSpacing: a negative one is read by its size"
    if len(header.frames) not in (0, header.frame_count):
        yield f"the header has fields of {len(header.frames)} frames for {header.frame_count} images"
    if device.is_curved:
        is_picture = not (layout.is_rf or layout.has_lines_in_rows)
        meaning = "images are taken for scan-converted" if is_picture else "its lines spread"
        yield f"the device set calls the transducer {device.geometry}: {meaning}"


def _file_frames(header: SequenceHeader, layout: Layout) -> FileFrames:
    """Frames of the pixels' type; RF of wider numbers than int16 as float32."""
    dtype, narrow = header.dtype.newbyteorder("="), None
    if layout.is_complex:
        dtype, narrow = np.dtype(np.complex64), dtype if dtype == np.int16 else None
    elif layout.is_rf and dtype != np.int16:
        dtype = np.dtype(np.float32)
    shape = (header.frame_count, *layout.shape(header.size))
    return FileFrames(header.path, partial(_open_images, header, layout), shape, dtype, narrow)


def _open_images(header: SequenceHeader, layout: Layout) -> ReadFrame:
    """Map or unpack images, and turn them."""
    images = header.images()
    return lambda i: layout.frame(images[i])


def _length_text(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
