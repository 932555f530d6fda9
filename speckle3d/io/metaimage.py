"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
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
    pixel_axes,
    sensor_from_image,
    tracked_orientation,
    tracked_poses,
)
from speckle3d.io.plus.write import own_values
from speckle3d.io.pose_paths import timed_poses, usable
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row, Value, differs, rate_of

_SIZE_TOLERANCE = 0.1
"""How far the pixel of a header and that of its image calibration may differ; a nominal size and a measured
one were seen to differ by 8 %."""
_DEVICE = "the device set"
_OWN, _NO_VALUES = "as this package wrote it", ("probe", "full_scale")


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
    sequence = _Sequence.open(Path(path), settings or ImportSettings())
    tracker = sequence.tracker(0.0)
    if tracker is None:
        raise InvalidInputError(
            f"{path}: expected tracked poses (fields like ProbeToTrackerTransform), got {lacking_poses(path)}"
        )
    for note in sequence.readings(sequence.poses)[1]:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return tracker


def lacking_poses(path: PathLike) -> str:
    """Say which transforms an image sequence holds, if not those of the usual names."""
    header = read_header(path)
    advice = ": name the sensor's with --transform" if header.transforms else ""
    return f"{', '.join(header.transforms) or 'none'}{advice}"


def open_sequence(path: Path, settings: ImportSettings) -> Recording:
    """Read what a header says of its images and poses; the frames stay on disk.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose image status is not OK are left out.

    Raises
    ------
    FileError, InvalidInputError
        If it, or the device set beside it, cannot be read or does not make sense.
    """
    sequence = _Sequence.open(path, settings)
    return Recording.of(path, settings, sequence.rows(), sequence.recording)


@dataclass(frozen=True)
class _Sequence:
    """A header, and what else says how its images are to be read."""

    header: SequenceHeader
    settings: ImportSettings
    device: DeviceSet
    own: dict[str, Any]
    layout: Layout

    @classmethod
    def open(cls, path: Path, settings: ImportSettings) -> _Sequence:
        header = read_header(path)
        device = DeviceSet() if settings.plus_config is None else read_device_set(settings.plus_config)
        own = own_values(str(path), header.fields)
        return cls(header, settings, device, own, Layout.of(header, device.image_orientation))

    def recording(self) -> Recording:
        images, first_mm, remarks = self._images(), self.settings.first_sample_depth_mm, self._remarks()
        frames, values = self._frames(images, self.layout), self._values()
        if self.layout.is_complex and self._is_reversed(frames, values):
            frames = self._frames(images, replace(self.layout, conjugated=True))
            remarks.append("Q has the other sign in the file, as its phase tells: turned")
        tracker = self.tracker(self.own.get("first_sample_depth_mm", 0.0) if first_mm is None else first_mm)
        return Recording(
            Path(self.header.path),
            self.settings,
            frames,
            values,
            time_s=None if self.times is None else self.times[images],
            tracker=tracker,
            orientation=self._orientation(),
            chain="" if tracker is None else " * ".join(self._chain()),
            probe=self.settings.probe or self.own.get("probe") or self.device.probe,
            full_scale=self.own.get("full_scale", 255.0),
            assumptions=("parallel lines",) if self.layout.is_rf and not self.own else (),
            remarks=tuple(remarks),
        )

    @cached_property
    def poses(self) -> Poses | None:
        asked, reference = self.settings.tracker_transform, self.settings.reference_transform
        return tracked_poses(self.header.path, self.header.frames, asked, reference, self.device.names)

    @cached_property
    def stamps(self) -> FloatArray | None:
        """Time of every frame by its stamp or its axis, NaN where it has none.

        Stamps that are all the same are none.
        """
        stamps = [_number(frame.get("Timestamp")) for frame in self.header.frames]
        if len({*filter(np.isfinite, stamps)}) < min(2, self._count):
            return self.header.index_s
        return np.array(stamps + [np.nan] * (self._count - len(stamps)))

    @property
    def _count(self) -> int:
        images = self.header.frame_count if 0 not in self.header.stored else 0
        return max(images, len(self.header.frames))

    @cached_property
    def times(self) -> FloatArray | None:
        """Time of every frame: of a rate that is given, or `stamps`."""
        rate = self.settings.frame_rate_hz
        return self.stamps if rate is None else np.arange(self._count) / rate

    def _images(self) -> IntArray:
        """Numbers of the frames that are images with a time."""
        header, size = self.header, self.header.size
        if 0 in size or max(size[:2]) == 1:
            what = ": the recording of a tracker, for --poses" if header.transforms else ""
            raise InvalidInputError(
                f"{header.path}: expected pixels of images, got images of size {size[0]} x {size[1]}{what}"
            )
        if header.is_volume and not self.settings.frame_rate_hz:
            raise InvalidInputError(
                f"{header.path}: expected a sequence of images, got a volume, whose third axis is in space "
                "by its Kinds; if it is time, say so by --frame-rate-hz"
            )
        self.layout.require_lines(header)
        if header.packing == "raw":
            header.images()  # maps them, and refuses a file that ends early
        if not (images := self._chosen[0]).size:
            raise InvalidInputError(
                f"{header.path}: ImageStatus: expected a valid frame with a time, got none"
            )
        return images

    @cached_property
    def _chosen(self) -> tuple[IntArray, list[str]]:
        """Numbers of the frames that are images with a time, and a line of those left out."""
        if self.times is None:
            return np.flatnonzero(self._valid), []
        faults = np.where(self._valid, "", "not valid by their status").tolist()
        return usable("images", self.times[: len(faults)], faults)

    @property
    def _valid(self) -> BoolArray:
        """Frames whose image is valid; older files of PLUS say so in Status alone."""
        valid = np.ones(self.header.frame_count, dtype=bool)
        for i, frame in enumerate(self.header.frames[: valid.size]):
            valid[i] = {frame.get("ImageStatus", "OK"), frame.get("Status", "OK")} == {"OK"}
        return valid

    def _is_reversed(self, frames: FileFrames, values: dict[str, Value]) -> bool:
        """Whether I/Q that are said to carry their frequency turn backwards.

        In lines that are stored from the far end on, depth runs backwards and so does the phase, unless the
        writer thought of it.
        """
        names = "demodulation_frequency_hz", "centre_frequency_hz", "sampling_rate_hz"
        said = {name: one.value for name, one in values.items()}
        demodulation, centre, rate = (getattr(self.settings, name) or said.get(name) for name in names)
        if demodulation or not (centre and rate):
            return False
        return (carried_share(frames, centre, rate) or 0.0) <= -CARRIED[0]

    def _frames(self, images: IntArray, layout: Layout) -> FileFrames:
        """Frames of the pixels' type; wider whole numbers as int16 where it holds them, else float32."""
        header = self.header
        dtype, stored = header.dtype.newbyteorder("="), None
        if layout.is_complex:
            fits = dtype == np.int16 and not layout.conjugated  # the opposite of -32768 is none
            dtype, stored = np.dtype(np.complex64), dtype if fits else None
        elif layout.is_rf and dtype != np.int16:
            limits = np.iinfo(np.int16)
            fits = dtype.kind in "iu" and all(
                limits.min <= image.min() and image.max() <= limits.max for image in header.images()[images]
            )
            dtype = np.dtype(np.int16 if fits else np.float32)
        shape = (header.frame_count, *layout.shape(header.size))
        return FileFrames(header.path, SequenceFile(header, layout), shape, dtype, stored, images.tolist())

    def _values(self) -> dict[str, Value]:
        """What a sweep of this kind needs, and where file or device set have it."""
        own = {name: Value(value, _OWN) for name, value in self.own.items() if name not in _NO_VALUES}
        values, sizes, device = dict[str, Value](), self._pixel_mm(), self.device
        if self.stamps is not None and (rate := rate_of(self.stamps[np.isfinite(self.stamps)])):
            values["frame_rate_hz"] = Value(rate, "of its time stamps")
        across, down = (replace(sizes, value=size) for size in sizes.value or (None, None))
        if device.is_curved and (self.layout.is_rf or self.layout.has_lines_in_rows):
            return values | self._spreading_lines() | own
        if not self.layout.is_rf:
            return values | {"column_pitch_mm": across, "row_spacing_mm": down} | own
        if down.value is not None:
            values["row_spacing_mm"] = down
        elif device.width_mm is not None:
            vectors, _ = self.layout.shape(self.header.size)
            across = Value(device.width_mm / vectors, "ScanConversion of the device set", _DEVICE)
        return values | {"vector_pitch_mm": across} | own

    def _spreading_lines(self) -> dict[str, Value]:
        """Where the device set has the lines of a curved array, and the samples on them."""
        device, (_, samples) = self.device, self.layout.shape(self.header.size)
        angles = Value(device.angles_deg, "ScanConversion of the device set", _DEVICE)
        radii = device.radii_mm or (None, None)
        values = {"line_angles_deg": angles, "array_radius_mm": replace(angles, value=radii[0])}
        if device.radii_mm is not None and samples > 1:
            near, far = device.radii_mm
            values["row_spacing_mm"] = replace(angles, value=(far - near) / (samples - 1))
        return values

    def _pixel_mm(self) -> Value:
        """Lateral and axial distance of samples, mm: calibrated, spaced, or of the device set."""
        spaced, calibrated, given = self._spaced_mm(), Value(), self.settings.image_to_probe
        if (calibration := self.image_to_probe()) is not None:
            calibrated = replace(calibration, value=pixel_axes(calibration.value, self._where(calibration)))
        both = spaced.value is not None and calibrated.value is not None and not self.own and given is None
        if both and not np.allclose(spaced.value, calibrated.value, rtol=_SIZE_TOLERANCE, atol=0):
            raise InvalidInputError(
                f"{self.header.path}: expected an image calibration for pixels of {_shown(spaced.value)} mm, "
                f"as ElementSpacing says, got one for {_shown(calibrated.value)} mm"
            )
        if self.layout.is_rf:  # whose sampling rate is known better than by a calibration
            return spaced
        by_device = Value(self.device.pixel_mm(self.header.size), "device set", _DEVICE)
        return next((one for one in (calibrated, spaced, by_device) if one.value is not None), Value())

    def _spaced_mm(self) -> Value:
        spacing = self.header.spacing_mm
        if spacing is None:
            return Value()
        if not min(spacing) > 0:
            raise InvalidInputError(
                f"{self.header.path}: spacing of pixels: expected above zero, got {spacing}"
            )
        return Value(spacing[::-1] if self.layout.has_lines_in_rows else spacing, "ElementSpacing")

    def image_to_probe(self) -> Value | None:
        """Transform of this image's pixels to mm on the tracked tool."""
        path, names = self.header.path, self.device.names
        if self.settings.image_to_probe is not None:
            given = np.asarray(self.settings.image_to_probe, dtype=float)
            return Value(given, "image_to_probe", "image_to_probe")
        if self.poses is not None and self.poses.pixels is not None:
            return Value(self.poses.pixels, f"{self.poses.chain[0]}Transform")
        tool = names.probe if self.poses is None else self.poses.tool
        for name in (f"{names.image}To{tool}", "Calibration"):  # the second is of Ibis
            matrix = fixed_transform(path, self.header.fields, self.header.frames, name)
            if matrix is not None:
                return Value(matrix, f"{name}Transform")
        # The device set's is for the image that the machine shows, not for the lines it was made of.
        matrix = None if self.layout.is_rf else self.device.transform(names.image, tool)
        return None if matrix is None else Value(matrix, f"{names.image}To{tool}", _DEVICE)

    def _where(self, calibration: Value) -> str:
        path = self.device.path if calibration.said_by == _DEVICE else self.header.path
        return f"{path}: {calibration.source}"

    def _chain(self) -> list[str]:
        if self.poses is None:
            return []
        is_calibrated = self.poses.pixels is None and self.image_to_probe() is not None
        first = [f"{self.device.names.image}To{self.poses.tool}"] if is_calibrated else []
        return [*first, *self.poses.chain]

    def tracker(self, first_sample_depth_mm: float) -> Tracker | None:
        """The tracker, with the image on it if that is known; None without a pose that has a time."""
        readings, _ = self.readings(self.poses)
        if readings is None:
            return None
        calibration = self.image_to_probe()
        if calibration is None:
            return Tracker(readings)
        matrix, where = calibration.value, self._where(calibration)
        mounting = sensor_from_image(matrix, first_sample_depth_mm, where)
        return Tracker(readings, mounting, image_skew_rad=image_skew_rad(matrix, where))

    def readings(self, poses: Poses | None) -> tuple[TimedPoses | None, list[str]]:
        """Poses that have a time, and a line of those left out."""
        if poses is None or self.times is None:
            return None, []
        return timed_poses(self.times[: len(poses.faults)], poses.matrices, poses.faults)

    def _orientation(self) -> OrientationSensor | None:
        """The orientation sensor that this package wrote; None where there is none."""
        path, header = self.header.path, self.header
        readings, _ = self.readings(tracked_orientation(path, header.frames))
        if readings is None:
            return None
        matrix = fixed_transform(path, header.fields, header.frames, f"{IMAGE}To{ORIENTATION}")
        mounting = None if matrix is None else sensor_from_image(matrix, 0.0, path).rotation
        turned = TimedRotations(readings.time_s, readings.world_from_sensor.rotation)
        return OrientationSensor(turned, mounting)

    def _remarks(self) -> list[str]:
        """Tell what is left out, what contradicts, and which poses were not used."""
        header, device, count = self.header, self.device, self.header.frame_count
        notes = [*self._chosen[1], *self.readings(self.poses)[1]]
        if self.poses is None and header.transforms and self.settings.tracker_transform is None:
            notes.append(f"no tracker: the header's transforms are {lacking_poses(header.path)}")
        if len(header.frames) not in (0, count):
            notes.append(f"the header has fields of {len(header.frames)} frames for {count} images")
        if device.is_curved:
            is_picture = not (self.layout.is_rf or self.layout.has_lines_in_rows)
            what = "images are taken for scan-converted" if is_picture else "its lines spread"
            notes.append(f"the device set calls the transducer {device.geometry}: {what}")
        if device.clip is not None and device.clip.is_part_of(header.size):
            notes.append(
                f"the device set clips images for volumes, as `speckle3d volume` does: {device.clip}"
            )
        if header.is_volume:
            notes.append(
                "third axis is time, as the frame rate that is given says: by its Kinds it is in space"
            )
        given, spaced = self.settings.image_to_probe, self._spaced_mm().value
        if spaced is not None and given is not None:
            sizes = pixel_axes(np.asarray(given, dtype=float), "image_to_probe")
            if differs(sizes, spaced):
                notes.append(
                    f"pixels of {_shown(sizes)} mm, given by image_to_probe: the file says {_shown(spaced)}"
                )
        return notes

    def rows(self) -> list[Row]:
        """Facts of the header."""
        header, layout = self.header, self.layout
        kinds = {"UltrasoundImageType": layout.kind, "UltrasoundImageOrientation": layout.orientation}
        kind, orientation = (
            used if name in header.fields else f"{used} (assumed)" for name, used in kinds.items()
        )
        rows = [
            ("container", "NrrdImage" if header.is_nrrd else "MetaImage", ""),
            ("size", _shown(header.size), ""),
            ("images", str(header.frame_count), ""),
            ("images not valid", str(np.count_nonzero(~self._valid)), ""),
            ("spacing", _shown(header.spacing_mm or ()) or "unknown", "mm" if header.spacing_mm else ""),
            ("image type", kind, ""),
            ("image orientation", orientation, ""),
            ("pixel type", header.dtype.name, ""),
            ("packing", header.packing, ""),
            ("transforms", ", ".join(header.transforms) or "none", ""),
            ("time stamps", "yes" if any("Timestamp" in frame for frame in header.frames) else "no", ""),
        ]
        try:
            calibration = self.image_to_probe()
        except InvalidInputError as error:
            return [*rows, ("poses", f"none: {error}", "")]
        rows.append(("tracker of", " * ".join(self.poses.chain) if self.poses is not None else "none", ""))
        rows.append(("image calibration", "none" if calibration is None else self._where(calibration), ""))
        if self.settings.plus_config is not None:
            rows.append(("device set", self.settings.plus_config, ""))
        return rows


def _shown(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
