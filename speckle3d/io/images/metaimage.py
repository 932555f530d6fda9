"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.hdf5 import reading
from speckle3d.io.images.headers import SequenceHeader, is_image, read_header
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
from speckle3d.io.recordings import Facts, Recording, Value, differs

_PIXELS = ("column_pitch_mm", "row_spacing_mm")


@dataclass(frozen=True)
class _Sequence:
    """A header with what its settings add: the device set, the tracked tool, the image's place on it."""

    header: SequenceHeader
    settings: ImportSettings

    @cached_property
    def device(self) -> DeviceSet:
        config = self.settings.plus_config
        return DeviceSet() if config is None else read_device_set(config)

    @cached_property
    def layout(self) -> Layout:
        return Layout.of(self.header, self.device.text("PortUsImageOrientation") or None)

    @cached_property
    def time_s(self) -> FloatArray | None:
        """Time of each frame by its stamp, unless all are the same, or by its axis; NaN where it has none."""
        stamps = self.header.values("Timestamp", 1)[:, 0]
        is_clock = np.unique(stamps[np.isfinite(stamps)]).size >= min(2, stamps.size)
        return stamps if is_clock else self.header.axis_times_s

    @cached_property
    def poses(self) -> Poses | None:
        """Poses of the tracked tool."""
        chosen = self.settings
        return tracked_poses(
            self.header, chosen.tracker_transform, chosen.reference_transform, self.device.names
        )

    def readings(self, poses: Poses | None) -> tuple[TimedPoses | None, list[str]]:
        """Poses that have a time, and a line of those left out."""
        rate_hz = self.settings.frame_rate_hz
        times = self.time_s if rate_hz is None else np.arange(self.header.frame_count) / rate_hz
        return (
            (None, []) if poses is None or times is None else timed_poses(times, poses.matrices, poses.faults)
        )

    @cached_property
    def calibration(self) -> Value:
        """Transform of this image's pixels to mm on the tracked tool."""
        names, poses = self.device.names, self.poses
        image, tool = names.image, names.probe if poses is None else poses.tool
        if (matrix := self.settings.image_to_probe) is not None:
            return Value(np.reshape(matrix, (4, 4)), "image_to_probe")
        if poses is not None and poses.pixels is not None:
            return Value(poses.pixels, f"{poses.chain[0]}Transform")
        for name in (f"{image}To{tool}", "Calibration"):  # the second is of Ibis
            if (transform := fixed_transform(self.header, name)) is not None:
                return Value(transform, f"{name}Transform")
        # The device set's is for the image that the machine shows, not for the lines it was made of.
        transform = None if self.layout.is_rf else self.device.transform(image, tool)
        return Value(transform, f"{image}To{tool} of the device set")

    @cached_property
    def sizes(self) -> list[Value]:
        """Distances of columns and rows by the calibration, the header and the device set, mm."""
        spacing, place = self.header.spacing_mm, self.calibration
        if spacing and self.layout.has_lines_in_rows:
            spacing = spacing[::-1]
        if place.value is not None:
            place = replace(place, value=pixel_axes(place.value, f"{self.header.path}: {place.source}"))
        machine = Value(self.device.pixel_mm(self.header.size), "device set")
        return [place, Value(spacing, "ElementSpacing"), machine]

    @cached_property
    def values(self) -> dict[str, Value]:
        """Numbers that a sweep of this kind needs, with their sources."""
        layout, values = self.layout, dict[str, Value]()
        vectors, samples = layout.shape(self.header.size)
        # The sampling rate of RF is known better than by a calibration.
        sizes = self.sizes[1:2] if layout.is_rf else self.sizes
        pixel = next((size for size in sizes if size.value is not None), Value())
        across, down = (replace(pixel, value=size) for size in pixel.value or (None, None))

        scan = partial(Value, source="ScanConversion of the device set")
        width_mm = self.device.scan("TransducerWidthMm")
        if self.device.is_curved and (layout.is_rf or layout.has_lines_in_rows):
            near, far = self.device.scan("RadiusStartMm", "RadiusStopMm") or (None, 0.0)
            angles = self.device.scan("ThetaStartDeg", "ThetaStopDeg")
            values = {"line_angles_deg": scan(angles), "array_radius_mm": scan(near)}
            if near is not None and samples > 1:
                values["row_spacing_mm"] = scan((far - near) / (samples - 1))
        elif not layout.is_rf or down.value is not None:
            values = {f"{'vector' if layout.is_rf else 'column'}_pitch_mm": across, "row_spacing_mm": down}
        elif width_mm is not None:
            values = {"vector_pitch_mm": scan(width_mm[0] / vectors)}
        return values

    @property
    def faults(self) -> list[str]:
        """Why each image is of no use; older files of PLUS tell it in Status alone."""
        statuses = self.header.column("Status") | self.header.column("ImageStatus")
        is_valid = (statuses.get(i, "OK") == "OK" for i in range(self.header.frame_count))
        return ["" if valid else "not valid by their status" for valid in is_valid]

    @property
    def orientation(self) -> OrientationSensor | None:
        """The orientation sensor, as this package writes it."""
        name, header = f"{ORIENTATION}ToWorld", self.header
        is_there = name in names_of(header)
        readings, _ = self.readings(tracked_poses(header, name, "none", Names()) if is_there else None)
        if readings is None:
            return None
        matrix = fixed_transform(header, f"{IMAGE}To{ORIENTATION}")
        mounting = None if matrix is None else sensor_from_image(matrix, 0.0, header.path)[0].rotation
        return OrientationSensor(
            TimedRotations(readings.time_s, readings.world_from_sensor.rotation), mounting
        )

    @property
    def frames(self) -> FileFrames:
        """Frames of the pixels' type; RF of wider numbers than int16 as float32."""
        header, layout = self.header, self.layout
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


def read_poses(path: PathLike, settings: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    with reading(path):  # of more frames than memory has places for
        sequence = _Sequence(read_header(path), settings or ImportSettings())
        readings, notes = sequence.readings(sequence.poses)
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
    header = read_header(path)
    sequence, names = _Sequence(header, settings), names_of(header)
    layout, device = sequence.layout, sequence.device
    yield "container", header.container, ""
    yield "size", _length_text(header.size) if header.has_images else "no images", ""
    if header.has_images:
        for name, word in (("Type", layout.kind), ("Orientation", layout.orientation)):
            is_said = f"UltrasoundImage{name}" in header.fields
            yield f"image {name.lower()}", word if is_said else f"{word} (assumed)", ""
    yield "transforms", ", ".join(names) or "none", ""
    if not header.has_images:
        use = f"a tracker's recording of {header.frame_count} frames, for --poses"
        raise InvalidInputError(f"expected pixels of images, got {use if names else 'none'}")
    if header.is_volume and not settings.frame_rate_hz:
        raise InvalidInputError(
            "expected a sequence of images, got a volume, whose third axis is in space by its Kinds; if it "
            "is time, say so by --frame-rate-hz"
        )
    layout.require_lines(header)
    if header.encoding == "raw":  # of packed ones the number shows when they are unpacked
        header.numbers()
    own, poses, place = own_values(header.path, header.fields), sequence.poses, sequence.calibration
    readings, remarks = sequence.readings(poses)
    chain, substitutes, image = "", dict[str, str](), device.names.image
    if poses is not None:
        has_mounting = place.value is not None and poses.pixels is None
        chain = " * ".join([*[f"{image}To{poses.tool}"] * has_mounting, *poses.chain])
        direct = f"{image}To{ends(poses.chain[-1])[1]}"
        if place.value is None and direct in names:
            substitutes = dict.fromkeys(_PIXELS, "tracker_transform")
            remarks.append(f"no place of the image on the tool: --transform {direct} takes the file's own")
    elif names and settings.tracker_transform is None:
        remarks.append(f"no tracker: the header's transforms are {lacking_poses(path)}")
    size, spacing, _ = sequence.sizes
    if not own and size.value and spacing.value and differs(size.value, spacing.value):
        pixels = f"pixels of {_length_text(size.value)} mm, {size.source}"
        remarks.append(f"{pixels}: the file says {_length_text(spacing.value)}")
    if len(header.frames) not in (0, header.frame_count):
        count = len(header.frames)
        remarks.append(f"the header has fields of {count} frames for {header.frame_count} images")
    if device.is_curved:
        is_picture = not (layout.is_rf or layout.has_lines_in_rows)
        meaning = "images are taken for scan-converted" if is_picture else "its lines spread"
        remarks.append(f"the device set calls the transducer {device.geometry}: {meaning}")
    first_mm = settings.first_sample_depth_mm
    if first_mm is None:
        first_mm = own.get("first_sample_depth_mm", 0.0)
    tracker = None if readings is None else Tracker(readings)
    if tracker is not None and place.value is not None:
        mounting, skew_rad = sensor_from_image(place.value, first_mm, f"{path}: {place.source}")
        tracker = replace(tracker, sensor_from_image=mounting, image_skew_rad=skew_rad)
    return Recording(
        path,
        settings,
        sequence.frames,
        sequence.values | {name: Value(number, "as this package wrote it") for name, number in own.items()},
        time_s=sequence.time_s,
        faults=sequence.faults,
        tracker=tracker,
        orientation=sequence.orientation,
        chain=chain,
        probe=settings.probe or own.get("probe") or device.text("TransducerName"),
        full_scale=own.get("full_scale", 255.0),
        substitutes=substitutes,
        assumptions=("parallel lines",) if layout.is_rf and not own else (),
        remarks=tuple(remarks),
    )


def _length_text(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
