"""What a sequence's header says of its sweep, with settings and a device set beside it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, ImageGrid, OrientationSensor, RFSettings, Tracker
from speckle3d.io.hdf5 import PathLike
from speckle3d.io.headers import SequenceHeader, read_header
from speckle3d.io.import_settings import SPEED_OF_SOUND_M_S, ImportSettings
from speckle3d.io.plus.device_set import DeviceSet, read_device_set
from speckle3d.io.plus.layout import Layout, layout_of
from speckle3d.io.plus.own_fields import own_values
from speckle3d.io.plus.record import SequenceRecord, record_of
from speckle3d.io.plus.transforms import (
    IMAGE,
    ORIENTATION,
    Poses,
    fixed_transform,
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
                f"{self.path}: expected a sequence of images, got a volume, whose third axis is in space"
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
        own, device = self.own, self.device
        first = {"first_sample_depth_mm": own.get("first_sample_depth_mm", 0.0)}
        times = {} if self.has_times else {"frame_rate_hz": None}
        lateral_mm, axial_mm = self.pixel_mm()
        if not self.layout.is_rf:
            sizes = {"column_pitch_mm": lateral_mm, "row_spacing_mm": axial_mm}
            return sizes | {"dynamic_range_db": own.get("dynamic_range_db")} | first | times
        speed = self.settings.speed_of_sound_m_s or own.get("speed_of_sound_m_s", SPEED_OF_SOUND_M_S)
        implied = None if axial_mm is None else 1e3 * speed / (2.0 * axial_mm)
        vectors, _ = self.layout.shape(self.header.size)
        middle = (
            {"demodulation_frequency_hz": own.get("demodulation_frequency_hz")}
            if self.layout.is_complex
            else {}
        )
        return {
            "sampling_rate_hz": own.get("sampling_rate_hz", implied),
            "vector_pitch_mm": lateral_mm or device.line_pitch_mm(self.path, vectors),
            "centre_frequency_hz": own.get("centre_frequency_hz"),
            "bandwidth_hz": own.get("bandwidth_hz"),
            "speed_of_sound_m_s": speed,
            **middle,
            **first,
            **times,
        }

    def pixel_mm(self) -> tuple[float | None, float | None]:
        """Lateral and axial distance of samples as far as known, mm."""
        own = self.own
        lateral = own.get("vector_pitch_mm", own.get("column_pitch_mm"))
        if lateral is not None:
            return lateral, own.get("row_spacing_mm")
        held = self.header.spacing_mm
        if held is not None and not min(held) > 0:
            raise InvalidInputError(f"{self.path}: spacing of pixels: expected above zero, got {held}")
        if held is not None and self.layout.has_lines_in_rows:
            held = held[::-1]
        calibrated = self._calibrated_pixel_mm()
        if (
            held is not None
            and calibrated is not None
            and self.settings.image_to_probe is None
            and not np.allclose(held, calibrated, rtol=_SIZE_TOLERANCE, atol=0)
        ):
            given, got = (" x ".join(f"{size:g}" for size in sizes) for sizes in (held, calibrated))
            raise InvalidInputError(
                f"{self.path}: expected an image calibration for pixels of {given} mm, as ElementSpacing "
                f"says, got one for {got} mm"
            )
        if self.layout.is_rf:  # whose sampling rate is known better than by a calibration
            return held or (None, None)
        return calibrated or held or self.device.pixel_mm(self.header.size) or (None, None)

    def _calibrated_pixel_mm(self) -> tuple[float, float] | None:
        found = self.image_to_probe()
        return None if found is None else pixel_axes(*found)

    def image_to_probe(self) -> tuple[FloatArray, str] | None:
        """Transform of this image's pixels to mm on the tracked tool, and where it is from."""
        if self.settings.image_to_probe is not None:
            return np.asarray(self.settings.image_to_probe, dtype=float), "image_to_probe"
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
        """Rows that tell where values which the header does not say come from."""
        given, own = self.settings, self.own
        calibrated = self.image_to_probe()
        rows = [
            ("tracker of", "none" if self.poses is None else " and ".join(self.poses.names), ""),
            ("image calibration", "none" if calibrated is None else calibrated[1], ""),
        ]
        if given.plus_config is not None:
            rows.append(("device set", given.plus_config, ""))
        if given.first_sample_depth_mm is None and "first_sample_depth_mm" not in own:
            rows.append(("first sample depth", "0 (assumed)", "mm"))
        if self.layout.is_rf and given.speed_of_sound_m_s is None and "speed_of_sound_m_s" not in own:
            rows.append(("speed of sound", f"{SPEED_OF_SOUND_M_S:g} (assumed)", "m/s"))
        return rows

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
        )

    def tracker(self, grid: ImageGrid) -> Tracker | None:
        """The tracker, with the image on it if that is known."""
        poses = self.poses
        return None if poses is None else Tracker(poses.readings, self._mounting(grid))

    def _mounting(self, grid: ImageGrid) -> RigidTransform | None:
        found = self.image_to_probe()
        return None if found is None else sensor_from_image(found[0], grid.first_sample_depth_mm, found[1])

    def orientation(self) -> OrientationSensor | None:
        """The orientation sensor that this package wrote; None where there is none."""
        readings = tracked_orientation(self.path, self.header.frames)
        if readings is None:
            return None
        header, name = self.header, f"{IMAGE}To{ORIENTATION}"
        found = fixed_transform(self.path, header.fields, header.frames, name)
        mounting = None if found is None else sensor_from_image(found, 0.0, f"{self.path}: {name}").rotation
        return OrientationSensor(readings, mounting)
