"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

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
from speckle3d.io.recordings import Facts, Recording, Value, differs

_DEVICE, _PIXELS = "the device set", ("column_pitch_mm", "row_spacing_mm")


def read_poses(path: PathLike, settings: ImportSettings | None = None) -> Tracker:
    """Read the tracked poses in a header, whether or not there are images.

    Raises
    ------
    InvalidInputError
        If the header names no such transform, or no sample of it is valid.
    """
    with reading(path):  # of more frames than memory has places for
        readings, notes = _Sequence.of(path, settings or ImportSettings()).readings
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
    sequence = _Sequence.of(path, settings)
    header, layout = sequence.header, sequence.layout
    yield "container", header.container, ""
    yield "size", _length_text(header.size) if header.has_images else "no images", ""
    kinds = {"UltrasoundImageType": layout.kind, "UltrasoundImageOrientation": layout.orientation}
    for name, word in kinds.items() if header.has_images else ():
        words = name.removeprefix("Ultrasound").replace("Image", "image ").lower()
        yield words, word if name in header.fields else f"{word} (assumed)", ""
    yield "transforms", ", ".join(names_of(header)) or "none", ""
    sequence.require_images()
    return sequence.recording()


@dataclass(frozen=True)
class _Sequence:
    """A header, and what settings and a device set say over it."""

    header: SequenceHeader
    settings: ImportSettings
    device: DeviceSet

    @classmethod
    def of(cls, path: PathLike, settings: ImportSettings) -> _Sequence:
        config = settings.plus_config
        return cls(read_header(path), settings, DeviceSet() if config is None else read_device_set(config))

    @cached_property
    def layout(self) -> Layout:
        """Layout of the images."""
        return Layout.of(self.header, self.device.text("PortUsImageOrientation") or None)

    @cached_property
    def poses(self) -> Poses | None:
        """Poses of the tracked tool."""
        settings = self.settings
        names = settings.tracker_transform, settings.reference_transform, self.device.names
        return tracked_poses(self.header, *names)

    @cached_property
    def own_values(self) -> dict[str, Any]:
        """Values that this package wrote."""
        return own_values(self.header.path, self.header.fields)

    @cached_property
    def image_to_probe(self) -> Value | None:
        """Transform of this image's pixels to mm on the tracked tool."""
        names, poses = self.device.names, self.poses
        if (matrix := self.settings.image_to_probe) is not None:
            return Value(np.reshape(matrix, (4, 4)), "image_to_probe", "image_to_probe")
        if poses is not None and poses.pixels is not None:
            return Value(poses.pixels, f"{poses.chain[0]}Transform")
        tool = names.probe if poses is None else poses.tool
        for name in (f"{names.image}To{tool}", "Calibration"):  # the second is of Ibis
            if (transform := fixed_transform(self.header, name)) is not None:
                return Value(transform, f"{name}Transform")
        # The device set's is for the image that the machine shows, not for the lines it was made of.
        transform = None if self.layout.is_rf else self.device.transform(names.image, tool)
        return None if transform is None else Value(transform, f"{names.image}To{tool}", _DEVICE)

    def require_images(self) -> None:
        """Raise unless these are ultrasound images and the file is long enough for them."""
        header, path = self.header, self.header.path
        if not header.has_images:
            use = f"a tracker's recording of {header.frame_count} frames, for --poses"
            raise InvalidInputError(
                f"{path}: expected pixels of images, got {use if names_of(header) else 'none'}"
            )
        if header.is_volume and not self.settings.frame_rate_hz:
            raise InvalidInputError(
                f"{path}: expected a sequence of images, got a volume, whose third axis is in space "
                "by its Kinds; if it is time, say so by --frame-rate-hz"
            )
        self.layout.require_lines(header)
        if header.encoding == "raw":  # of packed ones the number shows when they are unpacked
            header.numbers()

    def recording(self) -> Recording:
        """The recording, with all that header, settings and device set say."""
        header, settings, own = self.header, self.settings, self.own_values
        return Recording(
            Path(header.path),
            settings,
            _file_frames(header, self.layout),
            self.values,
            time_s=self._times(),
            faults=self._image_faults(),
            tracker=self._tracker(),
            orientation=self._orientation(),
            chain=self._chain(),
            probe=settings.probe or own.get("probe") or self.device.text("TransducerName"),
            full_scale=own.get("full_scale", 255.0),
            substitutes=dict.fromkeys(_PIXELS, "tracker_transform") if self.image_pose else {},
            assumptions=("parallel lines",) if self.layout.is_rf and not own else (),
            remarks=tuple(self._remarks()),
        )

    @cached_property
    def image_pose(self) -> str:
        """The file's own transform of the image in the tool's world; empty where the tool's are enough."""
        if self.poses is None or self.image_to_probe is not None:
            return ""
        name = f"{self.device.names.image}To{ends(self.poses.chain[-1])[1]}"
        return name if name in names_of(self.header) else ""

    @cached_property
    def readings(self) -> tuple[TimedPoses | None, list[str]]:
        """The tool's poses that have a time, and a line of those left out."""
        return self._timed_poses(self.poses)

    def _timed_poses(self, poses: Poses | None) -> tuple[TimedPoses | None, list[str]]:
        rate_hz, count = self.settings.frame_rate_hz, self.header.frame_count
        times = self._times() if rate_hz is None else np.arange(count) / rate_hz
        if poses is None or times is None:
            return None, []
        return timed_poses(times, poses.matrices, poses.faults)

    def _times(self) -> FloatArray | None:
        """Time of each frame by its stamp or its axis, NaN where it has none.

        Stamps all the same are none.
        """
        stamps = self.header.values("Timestamp", 1)[:, 0]
        is_clock = np.unique(stamps[np.isfinite(stamps)]).size >= min(2, stamps.size)
        return stamps if is_clock else self.header.axis_times_s

    def _image_faults(self) -> list[str]:
        """Why each image is of no use; older files of PLUS tell it in Status alone."""
        statuses = dict(self.header.column("Status")) | dict(self.header.column("ImageStatus"))
        is_valid = (statuses.get(i, "OK") == "OK" for i in range(self.header.frame_count))
        return ["" if valid else "not valid by their status" for valid in is_valid]

    @cached_property
    def spacing_mm(self) -> tuple[float, ...] | None:
        """Distances of columns and rows by the header."""
        spacing = self.header.spacing_mm
        return spacing[::-1] if spacing and self.layout.has_lines_in_rows else spacing

    @cached_property
    def calibration(self) -> Value:
        """Distances of columns and rows on the tracked tool."""
        if (transform := self.image_to_probe) is None:
            return Value()
        return replace(
            transform, value=pixel_axes(transform.value, f"{self.header.path}: {transform.source}")
        )

    @cached_property
    def values(self) -> dict[str, Value]:
        """Numbers that a sweep of this kind needs, with their sources."""
        header, device, layout = self.header, self.device, self.layout
        # The sampling rate of RF is known better than by a calibration.
        sizes = [Value(self.spacing_mm, "ElementSpacing")]
        if not layout.is_rf:
            sizes = [self.calibration, *sizes, Value(device.pixel_mm(header.size), "device set", _DEVICE)]
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
        own = {name: Value(number, "as this package wrote it") for name, number in self.own_values.items()}
        return values | own

    def _chain(self) -> str:
        """Transforms that lead from the image, or the tool, to the world."""
        if (poses := self.poses) is None:
            return ""
        has_mounting = self.image_to_probe is not None and poses.pixels is None
        mounting = [f"{self.device.names.image}To{poses.tool}"] if has_mounting else []
        return " * ".join([*mounting, *poses.chain])

    def _tracker(self) -> Tracker | None:
        """The tracker, with the image's place on it."""
        readings, transform = self.readings[0], self.image_to_probe
        if readings is None or transform is None:
            return None if readings is None else Tracker(readings)
        first_mm = self.settings.first_sample_depth_mm
        if first_mm is None:
            first_mm = self.own_values.get("first_sample_depth_mm", 0.0)
        where = f"{self.header.path}: {transform.source}"
        mounting, skew_rad = sensor_from_image(transform.value, first_mm, where)
        return Tracker(readings, mounting, image_skew_rad=skew_rad)

    def _orientation(self) -> OrientationSensor | None:
        """The orientation sensor, as this package writes it."""
        header, name = self.header, f"{ORIENTATION}ToWorld"
        if name not in names_of(header):
            return None
        readings, _ = self._timed_poses(tracked_poses(header, name, "none", Names()))
        if readings is None:
            return None
        matrix = fixed_transform(header, f"{IMAGE}To{ORIENTATION}")
        mounting = None if matrix is None else sensor_from_image(matrix, 0.0, header.path)[0].rotation
        rotations = readings.world_from_sensor.rotation
        return OrientationSensor(TimedRotations(readings.time_s, rotations), mounting)

    def _remarks(self) -> Iterator[str]:
        """Tell what contradicts, and which poses were not used."""
        header, device, layout, spacing = self.header, self.device, self.layout, self.spacing_mm
        size = self.calibration
        if size.value and spacing and not self.own_values and differs(size.value, spacing):
            text = f"{_length_text(size.value)} mm, {size.source}"
            yield f"pixels of {text}: the file says {_length_text(spacing)}"
        if " -" in f" {header.fields.get('ElementSpacing')}":
            yield "ElementSpacing: a negative one is read by its size"
        yield from self.readings[1]
        if self.image_pose:
            yield f"no place of the image on the tool: --transform {self.image_pose} takes the file's own"
        if self.poses is None and names_of(header) and self.settings.tracker_transform is None:
            yield f"no tracker: the header's transforms are {lacking_poses(header.path)}"
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
