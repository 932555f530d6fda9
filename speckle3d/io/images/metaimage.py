"""Image sequences in MetaImage and NRRD files, as PLUS, ITK, 3D Slicer and ultrasound machines write them.

PLUS's orientations name where the first and the second axis of an image lead: to the marked (M) or unmarked
(U) side of the probe, far from (F) or near to (N) it [1]_.

References
----------
.. [1] PLUS user manual, "Ultrasound image orientation".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import OrientationSensor
from speckle3d.io.frames import FileFrames, ReadFrame
from speckle3d.io.images.headers import SequenceHeader, is_image, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.device_set import DeviceSet, read_device_set
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    Poses,
    ends,
    fixed_transform,
    names_of,
    pixel_axes,
    sensor_from_image,
    tracked_poses,
)
from speckle3d.io.plus.write import own_values
from speckle3d.io.pose_paths import tracker_of
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts, Recording, Value, differs

_PIXELS = ("column_pitch_mm", "row_spacing_mm")
RF_TYPES = ("RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE")
_SIDES = ({"M", "F"}, {"M", "N"}, {"U", "F"}, {"U", "N"})


@dataclass(frozen=True)
class Layout:
    """Layout of the images of a file.

    Attributes
    ----------
    header : SequenceHeader
    kind : str
        PLUS's image type: BRIGHTNESS, RF_REAL, RF_IQ_LINE (I and Q in turn along a line) or RF_I_LINE_Q_LINE
        (a line of I, a line of Q).
    orientation : str
        As MF: columns to the marked side, rows away from the probe.
    """

    header: SequenceHeader
    kind: str
    orientation: str

    @classmethod
    def of(cls, header: SequenceHeader, machine: str) -> "Layout":
        """Tell an image's layout; where the header does not say, by pixels and as PLUS does by default.

        PLUS stores B-mode as MF and RF as FM. A machine's orientation, from a device set, replaces that for
        the kind of image whose lines run so.
        """
        by_pixels = "BRIGHTNESS" if header.dtype == np.uint8 else "RF_REAL"
        kind = header.fields.get("UltrasoundImageType", by_pixels)
        usual = "FM" if kind in RF_TYPES else "MF"
        if machine and (machine[:1].upper() in "FN") == (usual == "FM"):
            usual = machine
        return cls(header, kind, header.fields.get("UltrasoundImageOrientation", usual).upper())

    @property
    def is_rf(self) -> bool:
        """Whether samples are radio-frequency ones, real or I and Q."""
        return self.kind in RF_TYPES

    @property
    def is_complex(self) -> bool:
        """Whether samples are I and Q."""
        return self.kind in RF_TYPES[1:]

    @property
    def has_lines_in_rows(self) -> bool:
        """Whether depth grows, or shrinks, along the first axis."""
        return self.orientation.startswith(("F", "N"))

    def frame(self, pixels: AnyArray) -> AnyArray:
        """Turn pixels, shape (y, x), into samples, shape (vector, sample): marked and far sides last."""
        lines = pixels if self.has_lines_in_rows else pixels.T
        if self.is_complex:
            axis = int(self.kind == "RF_IQ_LINE")  # of (line, number), along which I and Q alternate
            pairs = np.moveaxis(lines, axis, 0)
            lines = np.moveaxis(pairs[0::2] + np.complex64(1j) * pairs[1::2], 0, axis)
        lines = lines[:, ::-1] if "N" in self.orientation[:2] else lines
        return lines[::-1] if "U" in self.orientation[:2] else lines

    @property
    def shape(self) -> tuple[int, int]:
        """Vectors and samples of an image."""
        vectors, samples = self.frame(np.broadcast_to(np.int8(0), self.header.size[1::-1])).shape
        return vectors, samples


def open_sequence(path: Path, settings: ImportSettings) -> Facts:
    """Read what a header says of its images and poses; the frames stay on disk.

    Frames are turned so that vectors run from the unmarked to the marked side and samples away from the
    probe. Frames whose image status is not OK are left out. A tracker's recording has poses alone.

    Raises
    ------
    FileError, InvalidInputError
        If it, or the device set beside it, cannot be read or does not make sense.
    """
    header, config = read_header(path), settings.plus_config
    device, names = DeviceSet() if config is None else read_device_set(config), names_of(header)
    layout = Layout.of(header, device.text("PortUsImageOrientation"))
    yield "container", header.container, ""
    yield "size", _length_text(header.size) if header.has_images else "no images", ""
    if header.has_images:
        for name, word in (("Type", layout.kind), ("Orientation", layout.orientation)):
            is_said = f"UltrasoundImage{name}" in header.fields
            yield f"image {name.lower()}", word if is_said else f"{word} (assumed)", ""
    yield "transforms", ", ".join(names) or "none", ""
    if header.has_images and header.encoding == "raw":  # of packed ones the number shows when unpacked
        header.numbers()
    chosen = settings.tracker_transform, settings.reference_transform
    poses = tracked_poses(header, *chosen, device.image, device.probe, [*device.transforms])
    times, rate_hz, remarks = _times(header), settings.frame_rate_hz, list[str]()
    clock, tracker = times if rate_hz is None else np.arange(header.frame_count) / rate_hz, None
    if poses is not None and clock is not None:
        tracker, remarks = tracker_of(clock, poses.matrices)
    elif poses is None and names and settings.tracker_transform is None:
        remarks.append(f"no tracker: of {', '.join(names)}, name the sensor's with --transform")
    if fault := _fault(layout, settings):
        error = InvalidInputError(f"{path}: {fault}")
        return Recording(path, settings, tracker=tracker, remarks=remarks, fault=error)
    own, place = own_values(header.path, header.fields), _calibration(settings, device, layout, poses)
    chain, substitutes = "", dict[str, str]()
    if poses is not None:
        has_mounting = place.value is not None and poses.pixels is None
        chain = " * ".join([*[f"{device.image}To{poses.tool}"] * has_mounting, *poses.chain])
        direct = f"{device.image}To{ends(poses.chain[-1])[1]}"
        if place.value is None and direct in names:
            substitutes = dict.fromkeys(_PIXELS, "tracker_transform")
            remarks.append(f"no place of the image on the tool: --transform {direct} takes the file's own")
    size, spacing = Value(), Value(header.spacing_mm, "ElementSpacing")
    if spacing.value and layout.has_lines_in_rows:
        spacing = replace(spacing, value=spacing.value[::-1])
    if place.value is not None:
        size = replace(place, value=pixel_axes(place.value, f"{path}: {place.source}"))
    if not own and size.value and spacing.value and differs(size.value, spacing.value):
        pixels = f"pixels of {_length_text(size.value)} mm, {size.source}"
        remarks.append(f"{pixels}: the file says {_length_text(spacing.value)}")
    # The sampling rate of RF is known better than by a calibration.
    sizes = [spacing] if layout.is_rf else [size, spacing, Value(device.pixel_mm(header.size), "device set")]
    if len(header.frames) not in (0, header.frame_count):
        count = len(header.frames)
        remarks.append(f"the header has fields of {count} frames for {header.frame_count} images")
    if device.is_curved:
        is_picture = not (layout.is_rf or layout.has_lines_in_rows)
        meaning = "images are taken for scan-converted" if is_picture else "its lines spread"
        remarks.append(f"the device set calls the transducer {device.geometry}: {meaning}")
    if tracker is not None and place.value is not None:
        first_mm = settings.first_sample_depth_mm
        if first_mm is None:
            first_mm = own.get("first_sample_depth_mm", 0.0)
        mounting, skew_rad = sensor_from_image(place.value, first_mm, f"{path}: {place.source}")
        tracker = replace(tracker, sensor_from_image=mounting, image_skew_rad=skew_rad)
    own_numbers = {name: Value(number, "as this package wrote it") for name, number in own.items()}
    return Recording(
        path,
        settings,
        _frames(layout),
        _numbers(next((size for size in sizes if size.value is not None), Value()), device, layout)
        | own_numbers,
        times,
        _faults(header),
        tracker,
        _orientation(header, clock),
        chain,
        settings.probe or own.get("probe") or device.text("TransducerName"),
        full_scale=own.get("full_scale", 255.0),
        substitutes=substitutes,
        assumptions=("parallel lines",) if layout.is_rf and not own else (),
        remarks=remarks,
    )


def _fault(layout: Layout, settings: ImportSettings) -> str:
    """Why there is no sweep in a file; empty where there is."""
    header, kind, orientation = layout.header, layout.kind, layout.orientation
    if not header.has_images:
        use = f"a tracker's recording of {header.frame_count} frames, for --poses"
        return f"expected pixels of images, got {use if names_of(header) else 'none'}"
    if header.is_volume and not settings.frame_rate_hz:
        return (
            "expected a sequence of images, got a volume, whose third axis is in space by its Kinds; if it "
            "is time, say so by --frame-rate-hz"
        )
    content, dtype = "colour" if header.channels > 1 else kind, header.dtype.newbyteorder("=")
    if content not in (*RF_TYPES, "BRIGHTNESS"):
        return f"expected grey B-mode or RF images, got {content}: export them as grey"
    if not layout.is_rf and dtype != np.uint8:
        return f"expected B-mode of type uint8, got {dtype}"
    if {*orientation[:2]} not in _SIDES or orientation[2:] not in ("", "A", "D"):
        return f"UltrasoundImageOrientation: expected as MF, FM or MFA, got {orientation}"
    return ""


def _times(header: SequenceHeader) -> FloatArray | None:
    """Time of each frame by its stamp, unless all are the same, or by its axis; NaN where it has none."""
    stamps = header.values("Timestamp", 1)[:, 0]
    is_clock = np.unique(stamps[np.isfinite(stamps)]).size >= min(2, stamps.size)
    return stamps if is_clock else header.axis_times_s


def _faults(header: SequenceHeader) -> list[str]:
    """Why each image is of no use; older files of PLUS tell it in Status alone."""
    statuses = header.column("Status") | header.column("ImageStatus")
    words = (statuses.get(i, "OK") for i in range(header.frame_count))
    return ["" if word == "OK" else "not valid by their status" for word in words]


def _calibration(settings: ImportSettings, device: DeviceSet, layout: Layout, poses: Poses | None) -> Value:
    """Transform of this image's pixels to mm on the tracked tool."""
    tool = device.probe if poses is None else poses.tool
    if (matrix := settings.image_to_probe) is not None:
        return Value(np.reshape(matrix, (4, 4)), "image_to_probe")
    if poses is not None and poses.pixels is not None:
        return Value(poses.pixels, f"{poses.chain[0]}Transform")
    for name in (f"{device.image}To{tool}", "Calibration"):  # the second is of Ibis
        if (transform := fixed_transform(layout.header, name)) is not None:
            return Value(transform, f"{name}Transform")
    # The device set's is for the image that the machine shows, not for the lines it was made of.
    transform = None if layout.is_rf else device.transform(device.image, tool)
    return Value(transform, f"{device.image}To{tool} of the device set")


def _numbers(pixel: Value, device: DeviceSet, layout: Layout) -> dict[str, Value]:
    """Numbers that a sweep of this kind needs, by the size of a pixel and the device set."""
    vectors, samples = layout.shape
    across, down = (replace(pixel, value=size) for size in pixel.value or (None, None))
    scan = partial(Value, source="ScanConversion of the device set")
    width_mm = device.scan("TransducerWidthMm")
    if device.is_curved and (layout.is_rf or layout.has_lines_in_rows):
        near, far = device.scan("RadiusStartMm", "RadiusStopMm") or (None, 0.0)
        angles = device.scan("ThetaStartDeg", "ThetaStopDeg")
        values = {"line_angles_deg": scan(angles), "array_radius_mm": scan(near)}
        if near is not None and samples > 1:
            values["row_spacing_mm"] = scan((far - near) / (samples - 1))
        return values
    if layout.is_rf and down.value is None:
        return {} if width_mm is None else {"vector_pitch_mm": scan(width_mm[0] / vectors)}
    return {f"{'vector' if layout.is_rf else 'column'}_pitch_mm": across, "row_spacing_mm": down}


def _orientation(header: SequenceHeader, clock: FloatArray | None) -> OrientationSensor | None:
    """The orientation sensor, as this package writes it."""
    name = f"{ORIENTATION}ToWorld"
    poses = tracked_poses(header, name, "none") if name in names_of(header) else None
    if poses is None or clock is None:
        return None
    if (tracker := tracker_of(clock, poses.matrices)[0]) is None:
        return None
    matrix = fixed_transform(header, f"{IMAGE}To{ORIENTATION}")
    mounting = None if matrix is None else sensor_from_image(matrix, 0.0, header.path)[0].rotation
    time_s, turns = tracker.readings.time_s, tracker.readings.world_from_sensor.rotation
    return OrientationSensor(TimedRotations(time_s, turns), mounting)


def _frames(layout: Layout) -> FileFrames:
    """Frames of the pixels' type; RF of wider numbers than int16 as float32."""
    header = layout.header
    dtype, narrow = header.dtype.newbyteorder("="), None
    if layout.is_complex:
        dtype, narrow = np.dtype(np.complex64), dtype if dtype == np.int16 else None
    elif layout.is_rf and dtype != np.int16:
        dtype = np.dtype(np.float32)
    shape = (header.frame_count, *layout.shape)
    return FileFrames(header.path, partial(_open_images, layout), shape, dtype, narrow)


def _open_images(layout: Layout) -> ReadFrame:
    """Map or unpack images, and turn them."""
    images = layout.header.images()
    return lambda i: layout.frame(images[i])


def _length_text(lengths: Sequence[float]) -> str:
    return " x ".join(f"{length:g}" for length in lengths)


def _companions(path: Path) -> Sequence[Path]:
    data = read_header(path).data
    return () if data == path else (data,)


READER = Reader("image", lambda _, start: is_image(start), open_sequence, companions=_companions)
