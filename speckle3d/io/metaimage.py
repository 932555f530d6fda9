"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.io.carrier import CARRIED, carried_share
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.headers import SequenceHeader, is_image, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.device_set import DeviceSet, read_device_set
from speckle3d.io.plus.layout import Layout
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    Poses,
    fixed_transform,
    image_skew_rad,
    names_of,
    pixel_axes,
    sensor_from_image,
    tracked_orientation,
    tracked_poses,
)
from speckle3d.io.plus.write import own_values
from speckle3d.io.pose_paths import timed_poses, usable
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Value, differs, rate_of

_DEVICE = "the device set"
_OWN, _NO_VALUES = "as this package wrote it", ("probe", "full_scale", "dynamic_range_sigma_db")
_CARRIER = ("demodulation_frequency_hz", "centre_frequency_hz", "sampling_rate_hz")


@dataclass(frozen=True)
class SequenceFile:
    """Opens the images of a sequence."""

    header: SequenceHeader
    layout: Layout

    def __call__(self) -> ReadFrame:
        """Map or unpack them."""
        images = self.header.images()
        return lambda i: self.layout.frame(images[i])


def read_poses(path: PathLike, settings: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    header, given = read_header(path), settings or ImportSettings()
    poses, times = _poses(header, given, _device(given)), _times(header, given)
    readings, notes = _timed(poses, times)
    if readings is None:
        raise InvalidInputError(
            f"{path}: expected tracked poses (fields like ProbeToTrackerTransform), got {lacking_poses(path)}"
        )
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return Tracker(readings)


def lacking_poses(path: PathLike) -> str:
    """Say which transforms an image sequence holds, if not those of the usual names."""
    names = names_of(read_header(path).frames)
    return f"{', '.join(names)}: name the sensor's with --transform" if names else "none"


def open_sequence(path: Path, settings: ImportSettings) -> Recording:
    """Read what a header says of its images and poses; the frames stay on disk.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose image status is not OK are left out.

    Raises
    ------
    FileError, InvalidInputError
        If it, or the device set beside it, cannot be read or does not make sense.
    """
    header, device = read_header(path), _device(settings)
    layout = Layout.of(header, device.image_orientation)
    kinds = {"UltrasoundImageType": layout.kind, "UltrasoundImageOrientation": layout.orientation}
    kind, orientation = (
        word if name in header.fields else f"{word} (assumed)" for name, word in kinds.items()
    )
    rows = [
        ("container", "NrrdImage" if header.is_nrrd else "MetaImage", ""),
        ("size", _shown(header.size), ""),
        ("images not valid", str(len([*filter(None, _faults(header))])), ""),
        ("spacing", _shown(header.spacing_mm or ()) or "unknown", "mm" if header.spacing_mm else ""),
        ("image type", kind, ""),
        ("image orientation", orientation, ""),
        ("transforms", ", ".join(names_of(header.frames)) or "none", ""),
    ]
    if settings.plus_config is not None:
        rows.append(("device set", settings.plus_config, ""))
    return Recording.of(path, settings, rows, lambda: _recording(header, settings, device, layout))


def _recording(
    header: SequenceHeader, settings: ImportSettings, device: DeviceSet, layout: Layout
) -> Recording:
    path, own = header.path, own_values(header.path, header.fields)
    _require_images(header, layout, settings)
    times, faults = _times(header, settings), _faults(header)
    images, remarks = np.flatnonzero(~np.array(faults, dtype=bool)), list[str]()
    if times is not None:
        images, remarks = usable("images", times[: len(faults)], faults)
    if not images.size:
        raise InvalidInputError(f"{path}: ImageStatus: expected a valid frame with a time, got none")
    poses = _poses(header, settings, device)
    pixels = _image_to_probe(header, settings, device, layout, poses)
    measured, where = Value(), path
    if pixels is not None:
        where = f"{device.path if pixels.said_by == _DEVICE else path}: {pixels.source}"
        measured = replace(pixels, value=pixel_axes(pixels.value, where))
    spacing = header.spacing_mm
    spacing = None if spacing is None else spacing[::-1] if layout.has_lines_in_rows else spacing
    if measured.value and spacing and not own and differs(measured.value, spacing):
        text = f"pixels of {_shown(measured.value)} mm, {measured.source}: the file says {_shown(spacing)}"
        remarks.append(text)
    # The sampling rate of RF is known better than by a calibration.
    sizes = [Value(spacing, "ElementSpacing" if spacing else "")]
    if not layout.is_rf:
        sizes = [measured, *sizes, Value(device.pixel_mm(header.size), "device set", _DEVICE)]
    pixel = next((size for size in sizes if size.value is not None), Value())
    values = _values(header, layout, device, pixel) | {
        name: Value(value, "as this package wrote it")
        for name, value in own.items()
        if name not in _NO_VALUES
    }
    frames = _frames(header, layout, images)
    if layout.is_complex:
        demodulation, centre, rate = (
            getattr(settings, name) or values.get(name, Value()).value for name in _CARRIER
        )
        # Depth runs backwards in lines that are stored from the far end on, and so does their phase.
        share = None if demodulation or not (centre and rate) else carried_share(frames, centre, rate)
        if share is not None and share <= -CARRIED[0]:
            frames = _frames(header, replace(layout, conjugated=True), images)
            remarks.append("Q has the other sign in the file, as its phase tells: turned")
    readings, lost = _timed(poses, times)
    tracker, chain = None, [*poses.chain] if poses is not None else []
    if poses is not None and poses.pixels is None and pixels is not None:
        chain.insert(0, f"{device.names.image}To{poses.tool}")
    if readings is not None and pixels is not None:
        first_mm = settings.first_sample_depth_mm
        first_mm = own.get("first_sample_depth_mm", 0.0) if first_mm is None else first_mm
        mounting = sensor_from_image(pixels.value, first_mm, where)
        tracker = Tracker(readings, mounting, image_skew_rad=image_skew_rad(pixels.value, where))
    elif readings is not None:
        tracker = Tracker(readings)
    return Recording(
        Path(path),
        settings,
        frames,
        values,
        time_s=None if times is None else times[images],
        tracker=tracker,
        orientation=_orientation(header, times),
        chain=" * ".join(chain),
        probe=settings.probe or own.get("probe") or device.probe,
        full_scale=own.get("full_scale", 255.0),
        range_sigma_db=own.get("dynamic_range_sigma_db", 0.0),
        assumptions=("parallel lines",) if layout.is_rf and not own else (),
        rows=(("tracker of", " * ".join(chain) or "none", ""),),
        remarks=(*remarks, *lost, *_remarks(header, settings, device, layout, poses)),
    )


def _require_images(header: SequenceHeader, layout: Layout, settings: ImportSettings) -> None:
    """Refuse what is no sequence of images of lines."""
    if 0 in header.size or max(header.size[:2]) == 1:
        what = ": the recording of a tracker, for --poses" if names_of(header.frames) else ""
        raise InvalidInputError(
            f"{header.path}: expected pixels of images, got images of size {_shown(header.size[:2])}{what}"
        )
    if header.is_volume and not settings.frame_rate_hz:
        raise InvalidInputError(
            f"{header.path}: expected a sequence of images, got a volume, whose third axis is in space "
            "by its Kinds; if it is time, say so by --frame-rate-hz"
        )
    layout.require_lines(header)
    if header.packing == "raw":
        header.images()  # maps them, and refuses a file that ends early


def _device(settings: ImportSettings) -> DeviceSet:
    return DeviceSet() if settings.plus_config is None else read_device_set(settings.plus_config)


def _poses(header: SequenceHeader, settings: ImportSettings, device: DeviceSet) -> Poses | None:
    asked, reference = settings.tracker_transform, settings.reference_transform
    return tracked_poses(header.path, header.frames, asked, reference, device.names)


def _timed(poses: Poses | None, times: FloatArray | None) -> tuple[TimedPoses | None, list[str]]:
    """Poses that have a time, and a line of those left out."""
    if poses is None or times is None:
        return None, []
    return timed_poses(times[: len(poses.faults)], poses.matrices, poses.faults)


def _times(header: SequenceHeader, settings: ImportSettings) -> FloatArray | None:
    """Time of every frame: of a rate that is given, or as the file has it."""
    rate, count = settings.frame_rate_hz, _count(header)
    return _stamps(header) if rate is None else np.arange(count) / rate


def _stamps(header: SequenceHeader) -> FloatArray | None:
    """Time of every frame by its stamp or its axis, NaN where it has none; stamps all the same are none."""
    stamps = np.full(_count(header), np.nan)
    for i, frame in enumerate(header.frames):
        with suppress(ValueError):
            stamps[i] = float(frame.get("Timestamp", "nan"))
    different = np.unique(stamps[np.isfinite(stamps)]).size
    return header.index_s if different < min(2, stamps.size) else stamps


def _count(header: SequenceHeader) -> int:
    return max(header.frame_count if 0 not in header.stored else 0, len(header.frames))


def _faults(header: SequenceHeader) -> list[str]:
    """Why each image is not valid, empty where it is; older files of PLUS say so in Status alone."""
    count = header.frame_count
    statuses = [{frame.get("ImageStatus"), frame.get("Status")} for frame in header.frames[:count]]
    faults = ["" if status <= {None, "OK"} else "not valid by their status" for status in statuses]
    return faults + [""] * (count - len(faults))


def _frames(header: SequenceHeader, layout: Layout, images: IntArray) -> FileFrames:
    """Frames of the pixels' type; RF of wider numbers than int16 as float32."""
    dtype, stored = header.dtype.newbyteorder("="), None
    if layout.is_complex:
        is_narrow = dtype == np.int16 and not layout.conjugated  # the opposite of -32768 is none
        dtype, stored = np.dtype(np.complex64), dtype if is_narrow else None
    elif layout.is_rf and dtype != np.int16:
        dtype = np.dtype(np.float32)
    shape = (header.frame_count, *layout.shape(header.size))
    return FileFrames(header.path, SequenceFile(header, layout), shape, dtype, stored, images.tolist())


def _values(header: SequenceHeader, layout: Layout, device: DeviceSet, pixel: Value) -> dict[str, Value]:
    """What a sweep of this kind needs, and where file or device set have it."""
    values, stamps = dict[str, Value](), _stamps(header)
    if stamps is not None and (rate := rate_of(stamps[np.isfinite(stamps)])):
        values["frame_rate_hz"] = Value(rate, "of its time stamps")
    across, down = (replace(pixel, value=size) for size in pixel.value or (None, None))
    vectors, samples = layout.shape(header.size)
    scan = Value(None, "ScanConversion of the device set", _DEVICE)
    if device.is_curved and (layout.is_rf or layout.has_lines_in_rows):
        values["line_angles_deg"] = replace(scan, value=device.angles_deg)
        values["array_radius_mm"] = scan
        if device.radii_mm is not None and samples > 1:
            near, far = device.radii_mm
            values["array_radius_mm"] = replace(scan, value=near)
            values["row_spacing_mm"] = replace(scan, value=(far - near) / (samples - 1))
    elif not layout.is_rf:
        values |= {"column_pitch_mm": across, "row_spacing_mm": down}
    elif down.value is not None:
        values |= {"vector_pitch_mm": across, "row_spacing_mm": down}
    elif device.width_mm is not None:
        values["vector_pitch_mm"] = replace(scan, value=device.width_mm / vectors)
    return values


def _image_to_probe(
    header: SequenceHeader, settings: ImportSettings, device: DeviceSet, layout: Layout, poses: Poses | None
) -> Value | None:
    """Transform of this image's pixels to mm on the tracked tool."""
    names = device.names
    if settings.image_to_probe is not None:
        return Value(np.asarray(settings.image_to_probe, dtype=float), "image_to_probe", "image_to_probe")
    if poses is not None and poses.pixels is not None:
        return Value(poses.pixels, f"{poses.chain[0]}Transform")
    tool = names.probe if poses is None else poses.tool
    for name in (f"{names.image}To{tool}", "Calibration"):  # the second is of Ibis
        matrix = fixed_transform(header.path, header.fields, header.frames, name)
        if matrix is not None:
            return Value(matrix, f"{name}Transform")
    # The device set's is for the image that the machine shows, not for the lines it was made of.
    matrix = None if layout.is_rf else device.transform(names.image, tool)
    return None if matrix is None else Value(matrix, f"{names.image}To{tool}", _DEVICE)


def _orientation(header: SequenceHeader, times: FloatArray | None) -> OrientationSensor | None:
    """The orientation sensor that this package wrote; None where there is none."""
    readings, _ = _timed(tracked_orientation(header.path, header.frames), times)
    if readings is None:
        return None
    name = f"{IMAGE}To{ORIENTATION}"
    matrix = fixed_transform(header.path, header.fields, header.frames, name)
    mounting = None if matrix is None else sensor_from_image(matrix, 0.0, header.path).rotation
    turned = TimedRotations(readings.time_s, readings.world_from_sensor.rotation)
    return OrientationSensor(turned, mounting)


def _remarks(
    header: SequenceHeader, settings: ImportSettings, device: DeviceSet, layout: Layout, poses: Poses | None
) -> list[str]:
    """Tell what contradicts, and which poses were not used."""
    count, notes = header.frame_count, list[str]()
    if poses is None and names_of(header.frames) and settings.tracker_transform is None:
        notes.append(f"no tracker: the header's transforms are {lacking_poses(header.path)}")
    if len(header.frames) not in (0, count):
        notes.append(f"the header has fields of {len(header.frames)} frames for {count} images")
    if device.is_curved:
        is_picture = not (layout.is_rf or layout.has_lines_in_rows)
        what = "images are taken for scan-converted" if is_picture else "its lines spread"
        notes.append(f"the device set calls the transducer {device.geometry}: {what}")
    if device.clip is not None and device.clip.is_part_of(header.size):
        notes.append(f"the device set clips images for volumes, as `speckle3d volume` does: {device.clip}")
    if header.is_volume:
        notes.append("third axis is time, as the frame rate that is given says: by its Kinds it is in space")
    return notes


def _shown(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
