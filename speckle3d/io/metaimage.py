"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray
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
    Names,
    Poses,
    fixed_transform,
    names_of,
    pixel_axes,
    sensor_from_image,
    tracked_poses,
)
from speckle3d.io.plus.write import own_values
from speckle3d.io.pose_paths import timed_poses
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Value, differs

_DEVICE = "the device set"
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
    readings, notes = _timed(_poses(header, given, _device(given)), _times(header, given.frame_rate_hz))
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
    header, device = read_header(path), _device(settings)
    layout = Layout.of(header, device.text("PortUsImageOrientation") or None)
    kinds = {"UltrasoundImageType": layout.kind, "UltrasoundImageOrientation": layout.orientation}
    kind, orientation = (
        word if name in header.fields else f"{word} (assumed)" for name, word in kinds.items()
    )
    yield "container", header.container, ""
    yield "size", _shown(header.size), ""
    yield "image type", kind, ""
    yield "image orientation", orientation, ""
    yield "transforms", ", ".join(names_of(header)) or "none", ""
    if settings.plus_config is not None:
        yield "device set", settings.plus_config, ""
    return _recording(header, settings, device, layout)


def _recording(
    header: SequenceHeader, settings: ImportSettings, device: DeviceSet, layout: Layout
) -> Recording:
    path, frames, count = header.path, header.frames, header.frame_count
    if 0 in header.size or max(header.size[:2]) == 1:
        what = ": the recording of a tracker, for --poses" if names_of(header) else ""
        size = _shown(header.size[:2])
        raise InvalidInputError(f"{path}: expected pixels of images, got images of size {size}{what}")
    if header.is_volume and not settings.frame_rate_hz:
        raise InvalidInputError(
            f"{path}: expected a sequence of images, got a volume, whose third axis is in space "
            "by its Kinds; if it is time, say so by --frame-rate-hz"
        )
    layout.require_lines(header)
    if header.packing == "raw":
        header.images()  # maps them, and refuses a file that ends early
    # Older files of PLUS tell images that are not valid in Status alone.
    statuses = [{frame.get("ImageStatus"), frame.get("Status")} for frame in frames[:count]]
    faults = ["" if status <= {None, "OK"} else "not valid by their status" for status in statuses]
    faults += [""] * (count - len(faults))
    times, stamps, notes = _times(header, settings.frame_rate_hz), _times(header), list[str]()
    own, poses = own_values(path, header.fields), _poses(header, settings, device)
    pixels = _image_to_probe(header, settings, device, layout, poses)
    spacing, measured = header.spacing_mm, Value()
    where = path if pixels is None else f"{path}: {pixels.source}"
    if spacing is not None and layout.has_lines_in_rows:
        spacing = spacing[::-1]
    if pixels is not None:
        measured = replace(pixels, value=pixel_axes(pixels.value, where))
    if measured.value and spacing and not own and differs(measured.value, spacing):
        text = f"pixels of {_shown(measured.value)} mm, {measured.source}: the file says {_shown(spacing)}"
        notes.append(text)
    # The sampling rate of RF is known better than by a calibration.
    sizes = [Value(spacing, "ElementSpacing" if spacing else "")]
    if not layout.is_rf:
        sizes = [measured, *sizes, Value(device.pixel_mm(header.size), "device set", _DEVICE)]
    pixel = next((size for size in sizes if size.value is not None), Value())
    values = _values(header, layout, device, pixel)
    values |= {name: Value(value, "as this package wrote it") for name, value in own.items() if "_" in name}
    stacked = _frames(header, layout)
    if layout.is_complex:
        demodulation, centre, rate = (
            getattr(settings, name) or values.get(name, Value()).value for name in _CARRIER
        )
        # Depth runs backwards in lines that are stored from the far end on, and so does their phase.
        share = None if demodulation or not (centre and rate) else carried_share(stacked, centre, rate)
        if share is not None and share <= -CARRIED[0]:
            stacked = _frames(header, replace(layout, conjugated=True))
            notes.append("Q has the other sign in the file, as its phase tells: turned")
    readings, lost = _timed(poses, times)
    tracker = None if readings is None else Tracker(readings)
    chain = [] if poses is None else [*poses.chain]
    if pixels is not None and poses is not None and poses.pixels is None:
        chain.insert(0, f"{device.names.image}To{poses.tool}")
    if tracker is not None and pixels is not None:
        given_mm = settings.first_sample_depth_mm
        first_mm = own.get("first_sample_depth_mm", 0.0) if given_mm is None else given_mm
        mounting, skew_rad = sensor_from_image(pixels.value, first_mm, where)
        tracker = replace(tracker, sensor_from_image=mounting, image_skew_rad=skew_rad)
    orientation, name = None, f"{ORIENTATION}ToWorld"
    if name in names_of(header):  # the stream that this package writes
        turns, _ = _timed(tracked_poses(header, name, "none", Names()), times)
        matrix = fixed_transform(header, f"{IMAGE}To{ORIENTATION}")
        turn = None if matrix is None else sensor_from_image(matrix, 0.0, path)[0].rotation
        if turns is not None:
            orientation = OrientationSensor(
                TimedRotations(turns.time_s, turns.world_from_sensor.rotation), turn
            )
    return Recording(
        Path(path),
        settings,
        stacked,
        values,
        time_s=None if stamps is None else stamps[:count],
        faults=faults,
        tracker=tracker,
        orientation=orientation,
        chain=" * ".join(chain),
        probe=settings.probe or own.get("probe") or device.text("TransducerName"),
        full_scale=own.get("full_scale", 255.0),
        assumptions=("parallel lines",) if layout.is_rf and not own else (),
        remarks=(*notes, *lost, *_remarks(header, settings, device, layout, poses)),
    )


def _device(settings: ImportSettings) -> DeviceSet:
    return DeviceSet() if settings.plus_config is None else read_device_set(settings.plus_config)


def _poses(header: SequenceHeader, settings: ImportSettings, device: DeviceSet) -> Poses | None:
    return tracked_poses(header, settings.tracker_transform, settings.reference_transform, device.names)


def _timed(poses: Poses | None, times: FloatArray | None) -> tuple[TimedPoses | None, list[str]]:
    """Poses that have a time, and a line of those left out."""
    if poses is None or times is None:
        return None, []
    return timed_poses(times[: len(poses.faults)], poses.matrices, poses.faults)


def _times(header: SequenceHeader, rate_hz: float | None = None) -> FloatArray | None:
    """Time of every frame: of a rate, or by its stamp or its axis, NaN where it has none.

    Stamps all the same are none.
    """
    count = max(header.frame_count if 0 not in header.stored else 0, len(header.frames))
    if rate_hz is not None:
        return np.arange(count) / rate_hz
    stamps = np.full(count, np.nan)
    for i, frame in enumerate(header.frames):
        with suppress(ValueError):
            stamps[i] = float(frame.get("Timestamp", "nan"))
    different = np.unique(stamps[np.isfinite(stamps)]).size
    return header.index_s if different < min(2, count) else stamps


def _frames(header: SequenceHeader, layout: Layout) -> FileFrames:
    """Frames of the pixels' type; RF of wider numbers than int16 as float32."""
    dtype, stored = header.dtype.newbyteorder("="), None
    if layout.is_complex:
        is_narrow = dtype == np.int16 and not layout.conjugated  # the opposite of -32768 is none
        dtype, stored = np.dtype(np.complex64), dtype if is_narrow else None
    elif layout.is_rf and dtype != np.int16:
        dtype = np.dtype(np.float32)
    shape = (header.frame_count, *layout.shape(header.size))
    return FileFrames(header.path, SequenceFile(header, layout), shape, dtype, stored)


def _values(header: SequenceHeader, layout: Layout, device: DeviceSet, pixel: Value) -> dict[str, Value]:
    """What a sweep of this kind needs, and where file or device set have it."""
    values = dict[str, Value]()
    across, down = (replace(pixel, value=size) for size in pixel.value or (None, None))
    vectors, samples = layout.shape(header.size)

    def scanned(numbers: float | tuple[float, ...] | None) -> Value:
        return Value(numbers, "ScanConversion of the device set", _DEVICE)

    width_mm = device.scan("TransducerWidthMm")
    if device.is_curved and (layout.is_rf or layout.has_lines_in_rows):
        near, far = device.scan("RadiusStartMm", "RadiusStopMm") or (None, 0.0)
        angles = device.scan("ThetaStartDeg", "ThetaStopDeg")
        values |= {"line_angles_deg": scanned(angles), "array_radius_mm": scanned(near)}
        if near is not None and samples > 1:
            values["row_spacing_mm"] = scanned((far - near) / (samples - 1))
    elif not layout.is_rf or down.value is not None:
        values |= {f"{'vector' if layout.is_rf else 'column'}_pitch_mm": across, "row_spacing_mm": down}
    elif width_mm is not None:
        values["vector_pitch_mm"] = scanned(width_mm[0] / vectors)
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
        matrix = fixed_transform(header, name)
        if matrix is not None:
            return Value(matrix, f"{name}Transform")
    # The device set's is for the image that the machine shows, not for the lines it was made of.
    matrix = None if layout.is_rf else device.transform(names.image, tool)
    return None if matrix is None else Value(matrix, f"{names.image}To{tool}", _DEVICE)


def _remarks(
    header: SequenceHeader, settings: ImportSettings, device: DeviceSet, layout: Layout, poses: Poses | None
) -> Iterator[str]:
    """Tell what contradicts, and which poses were not used."""
    count = header.frame_count
    if poses is None and names_of(header) and settings.tracker_transform is None:
        yield f"no tracker: the header's transforms are {lacking_poses(header.path)}"
    if len(header.frames) not in (0, count):
        yield f"the header has fields of {len(header.frames)} frames for {count} images"
    if device.is_curved:
        is_picture = not (layout.is_rf or layout.has_lines_in_rows)
        what = "images are taken for scan-converted" if is_picture else "its lines spread"
        yield f"the device set calls the transducer {device.geometry}: {what}"
    if device.clip is not None and device.clip.is_part_of(header.size):
        yield f"the device set clips images for volumes, as `speckle3d volume` does: {device.clip}"
    if header.is_volume:
        yield "third axis is time, as the frame rate that is given says: by its Kinds it is in space"


def _shown(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
