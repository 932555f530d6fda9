"""What a sequence's header says of its sweep, with settings and a device set beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, ImageGrid, OrientationSensor, RFSettings, Tracker
from speckle3d.io.formats.recordings import rate_of
from speckle3d.io.found import ASSUMED, Found, contradictions, differs, rows_of
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.headers import SequenceHeader, read_header
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.device_set import DeviceSet, read_device_set
from speckle3d.io.plus.layout import Layout, layout_of
from speckle3d.io.plus.own_fields import own_values
from speckle3d.io.plus.record import SequenceRecord, record_of
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    Poses,
    fixed_transform,
    image_skew_rad,
    pixel_axes,
    sensor_from_image,
    time_stamps,
    tracked_orientation,
    tracked_poses,
)
from speckle3d.io.readers import Row

_SIZE_TOLERANCE = 0.1
"""How far the pixel of a header and that of its image calibration may differ; a nominal size and a measured
one were seen to differ by 8 %."""


_DEVICE = "the device set"


@dataclass(frozen=True)
class Source:
    """A header, and what else says how its images are to be read: settings, device set, own fields."""

    header: SequenceHeader
    settings: ImportSettings
    device: DeviceSet
    own: dict[str, Any]
    layout: Layout

    @classmethod
    def open(cls, path: PathLike, settings: ImportSettings) -> Source:
        """Read header and device set.

        Raises
        ------
        FileError, InvalidInputError
            If one of them cannot be read, or does not make sense.
        """
        header = read_header(path)
        device = DeviceSet() if settings.plus_config is None else read_device_set(settings.plus_config)
        own = own_values(str(path), header.fields)
        return cls(header, settings, device, own, layout_of(header, device.image_orientation))

    @property
    def path(self) -> str:
        """The sequence's, for messages."""
        return self.header.path

    @property
    def has_times(self) -> bool:
        """Whether frames are time-stamped."""
        return any("Timestamp" in frame for frame in self.header.frames)

    @property
    def probe(self) -> str:
        """Name of the probe as far as anything says."""
        return self.settings.probe or self.own.get("probe") or self.device.scan.probe

    def require_images(self) -> npt.NDArray[np.intp]:
        """Numbers of the frames that are images, or why there are none."""
        header, size = self.header, self.header.size
        if 0 in size or max(size[:2]) == 1:
            what = ": the recording of a tracker, for --poses" if header.transforms else ""
            raise InvalidInputError(
                f"{self.path}: expected pixels of images, got images of size {size[0]} x {size[1]}{what}"
            )
        if not {*header.kinds[:2]} <= {"domain", "space", "???", "none"}:
            raise InvalidInputError(
                f"{self.path}: kinds: expected images on the first two axes and their list on the third, got "
                f"{' '.join(header.kinds)}"
            )
        if header.is_volume and not self.settings.frame_rate_hz:
            raise InvalidInputError(
                f"{self.path}: expected a sequence of images, got a volume, whose third axis is in space by "
                "its Kinds; if it is time, say so by --frame-rate-hz"
            )
        if header.pixels.count != size[0] * size[1] * header.frame_count:
            raise InvalidInputError(
                f"{self.path}: expected grey pixels {size}, got {header.pixels.count} numbers"
            )
        self.layout.check(self.path, size, header.pixels.dtype.newbyteorder("="))
        if not header.frames:
            return np.arange(header.frame_count)
        if len(header.frames) != header.frame_count:
            raise InvalidInputError(
                f"{self.path}: expected the fields of {header.frame_count} frames, got {len(header.frames)}"
            )
        chosen = np.flatnonzero(self.record().has_image)
        if not chosen.size:
            raise InvalidInputError(f"{self.path}: ImageStatus: expected a valid frame, got none")
        return chosen

    def record(self, conjugated: bool = False) -> SequenceRecord:
        """Fields to keep with the sweep."""
        poses = self.poses
        return record_of(self.header, self.layout, () if poses is None else poses.names, conjugated)

    def wanted(self) -> dict[str, Any]:
        """What a sweep of this kind needs, as far as file or device set have it; else None."""
        return {name: one.value for name, one in self.found().items()}

    def found(self) -> dict[str, Found]:
        """What a sweep of this kind needs, and where file or device set have it."""
        sizes = self.pixel_mm()
        if not self.layout.is_rf:
            lateral, axial = (
                Found() if sizes.value is None else replace(sizes, value=size)
                for size in sizes.value or (None, None)
            )
            return {
                "column_pitch_mm": self._own("column_pitch_mm", self._own("vector_pitch_mm", lateral)),
                "row_spacing_mm": self._own("row_spacing_mm", axial),
                "dynamic_range_db": self._own("dynamic_range_db"),
                "first_sample_depth_mm": self._own("first_sample_depth_mm"),
                **self._found_rate(),
            }
        middle = ["demodulation_frequency_hz"] if self.layout.is_complex else []
        return {
            "sampling_rate_hz": self._own("sampling_rate_hz", self._implied_rate(sizes)),
            "vector_pitch_mm": self._line_pitch(sizes),
            **{
                name: self._own(name)
                for name in ("centre_frequency_hz", "bandwidth_hz", "speed_of_sound_m_s", *middle)
            },
            "first_sample_depth_mm": self._own("first_sample_depth_mm"),
            **self._found_rate(),
        }

    def _own(self, name: str, otherwise: Found | None = None) -> Found:
        """What a field says that this package wrote, else another, else what is assumed of all scanners."""
        value = self.own.get(name)
        if value is not None:
            return Found(value, "as this package wrote it")
        return otherwise or ASSUMED.get(name, Found())

    def _implied_rate(self, sizes: Found) -> Found:
        """Sampling rate of samples so far apart."""
        if sizes.value is None:
            return Found()
        speed = self.settings.speed_of_sound_m_s or self._own("speed_of_sound_m_s").value
        spacing_mm = sizes.value[1]
        source = f"of samples {spacing_mm:.6g} mm apart, by {sizes.source}, at {speed:g} m/s"
        return Found(1e3 * speed / (2.0 * spacing_mm), source, sizes.said_by)

    def _line_pitch(self, sizes: Found) -> Found:
        if "vector_pitch_mm" in self.own:
            return self._own("vector_pitch_mm")
        if sizes.value is not None:
            return replace(sizes, value=sizes.value[0])
        vectors, _ = self.layout.shape(self.header.size)
        pitch = self.device.line_pitch_mm(self.path, vectors)
        return Found(pitch, "ScanConversion of the device set", _DEVICE) if pitch else Found()

    def _found_rate(self) -> dict[str, Found]:
        """The frame rate, where it is needed or given."""
        if not self.has_times:
            return {"frame_rate_hz": Found()}
        if self.settings.frame_rate_hz is None:
            return {}
        try:
            stamped = rate_of(time_stamps(self.path, self.header.frames))
        except InvalidInputError:  # which is why a rate is given
            stamped = None
        return {"frame_rate_hz": Found(stamped, "of its time stamps")}

    def pixel_mm(self) -> Found:
        """Lateral and axial distance of samples, mm, but for those of fields that this package wrote."""
        if {"vector_pitch_mm", "column_pitch_mm"} & self.own.keys():
            return Found()
        held, calibrated = self._held_mm(), self._calibrated_pixel_mm()
        if (
            held is not None
            and calibrated.value is not None
            and self.settings.image_to_probe is None
            and not np.allclose(held, calibrated.value, rtol=_SIZE_TOLERANCE, atol=0)
        ):
            given, got = (" x ".join(f"{size:g}" for size in sizes) for sizes in (held, calibrated.value))
            raise InvalidInputError(
                f"{self.path}: expected an image calibration for pixels of {given} mm, as ElementSpacing "
                f"says, got one for {got} mm"
            )
        spaced = Found(held, "ElementSpacing") if held is not None else Found()
        if self.layout.is_rf:  # whose sampling rate is known better than by a calibration
            return spaced
        device_mm = self.device.pixel_mm(self.header.size)
        device = Found(device_mm, "device set", _DEVICE) if device_mm is not None else Found()
        return next((one for one in (calibrated, spaced, device) if one.value is not None), Found())

    def _held_mm(self) -> tuple[float, float] | None:
        """Pixel size by the header's spacing, lateral and axial, mm."""
        held = self.header.spacing_mm
        if held is not None and not min(held) > 0:
            raise InvalidInputError(f"{self.path}: spacing of pixels: expected above zero, got {held}")
        return held[::-1] if held is not None and self.layout.has_lines_in_rows else held

    def _calibrated_pixel_mm(self) -> Found:
        found = self.image_to_probe()
        if found is None:
            return Found()
        if self.settings.image_to_probe is not None:
            return Found(pixel_axes(*found), "image_to_probe", "image_to_probe")
        name = found[1].rsplit(": ", 1)[-1]
        return Found(pixel_axes(*found), name, "the file" if found[1].startswith(self.path) else _DEVICE)

    def contradictions(self) -> list[str]:
        """Tell what is given and is another than header or device set say."""
        notes = contradictions(self.path, self.found(), self.settings)
        if self.settings.frame_rate_hz is not None and self.has_times and self.poses is not None:
            notes.append("frame times are those of the frame rate from 0; poses keep the file's time stamps")
        if self.header.is_volume:
            notes.append(
                "third axis is time, as the frame rate that is given says: by its Kinds it is in space"
            )
        held, given = self._held_mm(), self.settings.image_to_probe
        if held is not None and given is not None:
            sizes = pixel_axes(np.asarray(given, dtype=float), "image_to_probe")
            if differs(sizes, held):
                shown, own = (" x ".join(f"{size:g}" for size in each) for each in (sizes, held))
                notes.append(f"pixels of {shown} mm, given by image_to_probe: the file says {own}")
        return notes

    def image_to_probe(self) -> tuple[FloatArray, str] | None:
        """Transform of this image's pixels to mm on the tracked tool, and where it is from."""
        if self.settings.image_to_probe is not None:
            return np.asarray(self.settings.image_to_probe, dtype=float), "image_to_probe"
        if self.poses is not None and self.poses.pixels is not None:
            return self.poses.pixels, f"{self.path}: {self.poses.names[0]}Transform"
        header, name = self.header, f"{self.device.image_frame}To{self.tool}"
        found = fixed_transform(self.path, header.fields, header.frames, name)
        if found is not None:
            return found, f"{self.path}: {name}Transform"
        # The device set's is for the image that the machine shows, not for the lines it was made of.
        if self.layout.is_rf:
            return None
        found = self.device.transform(IMAGE, self.tool)
        return None if found is None else (found, f"{self.settings.plus_config}: {name}")

    def sources(self) -> list[Row]:
        """Rows that tell what values are and where they come from."""
        calibrated = self.image_to_probe()
        rows = [
            ("tracker of", "none" if self.poses is None else " and ".join(self.poses.names), ""),
            ("image calibration", "none" if calibrated is None else calibrated[1], ""),
        ]
        if self.header.is_volume:
            as_time = "time, as the frame rate that is given says; in space by its Kinds"
            rows.append(("third axis", as_time if self.settings.frame_rate_hz else "in space", ""))
        if self.settings.plus_config is not None:
            rows.append(("device set", self.settings.plus_config, ""))
        return [*rows, *rows_of(self.path, self.found(), self.settings)]

    @property
    def tool(self) -> str:
        """Frame of the tracked tool, as Probe."""
        poses = self.poses
        return self.device.probe_frame if poses is None else poses.tool

    def geometry(
        self, values: dict[str, Any], shape: tuple[int, int, int]
    ) -> tuple[ImageGrid, RFSettings | BModeSettings]:
        """Make the grid and the signal of frames of a shape, of what `wanted` became."""
        _, vectors, samples = shape
        first_mm = values["first_sample_depth_mm"]
        if not self.layout.is_rf:
            sizes = values["column_pitch_mm"], values["row_spacing_mm"]
            signal = BModeSettings(values["dynamic_range_db"], self.own.get("full_scale", 255.0))
            return ImageGrid(vectors, samples, *sizes, first_mm), signal
        rf = RFSettings(
            values["sampling_rate_hz"],
            values["speed_of_sound_m_s"],
            values["centre_frequency_hz"],
            values["bandwidth_hz"],
            values.get("demodulation_frequency_hz"),
        )
        return ImageGrid(vectors, samples, values["vector_pitch_mm"], rf.sample_spacing_mm, first_mm), rf

    def frame_times(self, values: dict[str, Any]) -> FloatArray:
        """Times of all frames, s: stamped, or of a frame rate that is given."""
        rate = values.get("frame_rate_hz", self.settings.frame_rate_hz)
        if rate is not None:
            return np.asarray(np.arange(self.header.frame_count) / rate)
        return time_stamps(self.path, self.header.frames)

    @cached_property
    def poses(self) -> Poses | None:
        """Poses of the tracked tool; None where the frames hold none."""
        given = self.settings
        return tracked_poses(
            self.path,
            self.header.frames,
            given.tracker_transform,
            given.reference_transform,
            f"{self.device.probe_frame}To{self.device.tracker_frame}",
            self.device.image_frame,
        )

    def tracker(self, grid: ImageGrid) -> Tracker | None:
        """The tracker, with the image on it if that is known."""
        poses, found = self.poses, self.image_to_probe()
        if poses is None:
            return None
        if found is None:
            return Tracker(poses.readings)
        mounting = sensor_from_image(found[0], grid.first_sample_depth_mm, found[1])
        return Tracker(poses.readings, mounting, image_skew_rad=image_skew_rad(*found))

    def orientation(self) -> OrientationSensor | None:
        """The orientation sensor that this package wrote; None where there is none."""
        readings = tracked_orientation(self.path, self.header.frames)
        if readings is None:
            return None
        header, name = self.header, f"{IMAGE}To{ORIENTATION}"
        found = fixed_transform(self.path, header.fields, header.frames, name)
        mounting = None if found is None else sensor_from_image(found, 0.0, f"{self.path}: {name}").rotation
        return OrientationSensor(readings, mounting)
