"""A sweep: frames read lazily, where their samples lie, their clock, and the sensors that rode along."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import require_increasing
from speckle3d.core.images import ImageFrames
from speckle3d.core.shown import shown
from speckle3d.core.streams import Samples, TimedPoses, TimedRotations, TimedSamples

INERTIAL = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")
"""Vectors that an orientation sensor may measure beside its orientation, each of shape (m, 3)."""

LARGEST_SKEW_RAD = 0.2
"""Of an image's axes: those of published calibrations lean by 0.05."""


class Frames(Protocol):
    """Frames on disk or in memory; indexing reads one."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Sample type: int16, float32, uint8 for B-mode, or complex64 for I/Q and analytic data."""

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        """Read one frame, shape (vector, sample)."""


def stored_dtype(frames: Frames) -> np.dtype[Any]:
    """Type that frames are stored as: int16 for complex ones that say so by ``stored_dtype``, else their own.

    Pairs of int16 (I/Q) are read as complex64, and would take twice the room so.
    """
    pairs = np.dtype(np.int16)
    own: np.dtype[Any] = np.dtype(frames.dtype)
    return pairs if own.kind == "c" and getattr(frames, "stored_dtype", own) == pairs else own


_READING = threading.Lock()


def read_frame(frames: Frames, index: int) -> npt.NDArray[Any]:
    """Read one frame while other threads may read others.

    Frames that say ``any_thread = True`` are read as they are. Others, which may reuse their memory or hold a
    place in a file, are read one at a time, and each is copied.
    """
    if isinstance(frames, np.ndarray) or getattr(frames, "any_thread", False):
        return frames[index]
    with _READING:
        return np.array(frames[index])


@dataclass(frozen=True)
class _FramesPart:
    """Frames `first` to before `stop` of others, still read one at a time."""

    frames: Frames
    first: int
    stop: int

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.stop - self.first, *self.frames.shape[1:]

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.frames.dtype

    @property
    def stored_dtype(self) -> np.dtype[Any]:
        return stored_dtype(self.frames)

    @property
    def any_thread(self) -> bool:
        return True

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        return read_frame(self.frames, range(self.first, self.stop)[index])


@dataclass(frozen=True)
class RFSettings:
    """How radio-frequency vectors, or their I and Q, were sampled.

    Attributes
    ----------
    demodulation_frequency_hz : float, optional
        Frequency that complex samples (I/Q) were shifted down by; 0 where they still carry their frequency
        (the analytic signal); None where samples are real.
    """

    sampling_rate_hz: float
    speed_of_sound_m_s: float
    centre_frequency_hz: float
    bandwidth_hz: tuple[float, float]
    demodulation_frequency_hz: float | None = None

    def __post_init__(self) -> None:
        _require_positive(self, ("sampling_rate_hz", "speed_of_sound_m_s", "centre_frequency_hz"))
        low, high = self.bandwidth_hz
        middle, half = self.demodulation_frequency_hz, self.sampling_rate_hz / 2
        if middle is not None and not 0 <= middle < np.inf:
            raise InvalidInputError(f"demodulation_frequency_hz: expected zero or above, got {middle}")
        # I/Q hold as much on either side of the frequency they were shifted down by, the analytic signal
        # all up to the sampling rate.
        least, most = (middle - half, middle + half) if middle else (0, 2 * half if middle == 0 else half)
        if not (0 < low < high and least <= low and high <= most):
            raise InvalidInputError(
                f"bandwidth_hz: expected 0 < low < high from {least:g} to {most:g}, as sampled, "
                f"got ({low:g}, {high:g})"
            )

    @property
    def sample_spacing_mm(self) -> float:
        """Depth between neighbouring samples, mm."""
        return 1e3 * self.speed_of_sound_m_s / (2.0 * self.sampling_rate_hz)

    @property
    def are_complex(self) -> bool:
        """Whether samples are complex: I/Q, or the analytic signal."""
        return self.demodulation_frequency_hz is not None

    def bin_frequency_hz(self, length: int) -> FloatArray:
        """Frequency of the echo that each bin of a Fourier transform of `length` samples holds.

        Returns
        -------
        ndarray
            Of shape (length // 2 + 1,) for real samples, whose negative frequencies say nothing new, else of
            shape (length,), in the order of ``scipy.fft.fft``.
        """
        bins = np.arange(length if self.are_complex else length // 2 + 1, dtype=float)
        if self.demodulation_frequency_hz:
            bins[(length + 1) // 2 :] -= length
        return bins * (self.sampling_rate_hz / length) + (self.demodulation_frequency_hz or 0.0)


@dataclass(frozen=True)
class BModeSettings:
    """How log-compressed grey levels were made: full scale is 0 dB, zero is `-dynamic_range_db`."""

    dynamic_range_db: float
    full_scale: float = 255.0

    def __post_init__(self) -> None:
        _require_positive(self, ("dynamic_range_db", "full_scale"))


@dataclass(frozen=True)
class FanLines:
    """Scan lines that spread from a point, of curved and phased arrays.

    Attributes
    ----------
    apex_mm : tuple of float
        x and y, in P, of the point where the lines meet.
    radius_mm : float
        Distance of the array's face from there; 0 for a phased array, whose lines begin at the apex.
    first_rad, step_rad : float
        Angle of the first line from straight down, towards growing x, and between neighbouring lines.
    """

    apex_mm: tuple[float, float]
    radius_mm: float
    first_rad: float
    step_rad: float

    def __post_init__(self) -> None:
        numbers = (*self.apex_mm, self.radius_mm, self.first_rad, self.step_rad)
        if not (np.isfinite(numbers).all() and self.radius_mm >= 0 and self.step_rad > 0):
            raise InvalidInputError(
                "fan: expected a finite apex, a radius of zero or more and a step above zero, got "
                f"{self.apex_mm}, {self.radius_mm}, {self.step_rad}"
            )


@dataclass(frozen=True)
class ImageGrid:
    """Where the samples of a frame lie in the image plane P, mm.

    Attributes
    ----------
    vector_pitch_mm : float
        Distance of neighbouring vectors; of a fan's, along the arc at the middle sample.
    first_sample_depth_mm : float
        Of the first sample along its vector, from the array's face.
    skew_rad : float
        Angle by which rows and vectors lean towards each other, half of it each, about the first sample: in
        images whose measured calibration is not square, when they are compounded; else zero.
    fan : FanLines, optional
        Where the vectors of a curved or phased array lie; without it they are parallel.
    """

    vectors: int
    samples: int
    vector_pitch_mm: float
    sample_spacing_mm: float
    first_sample_depth_mm: float = 0.0
    skew_rad: float = 0.0
    fan: FanLines | None = None

    def __post_init__(self) -> None:
        _require_positive(self, ("vectors", "samples", "vector_pitch_mm", "sample_spacing_mm"))
        if not np.isfinite(self.first_sample_depth_mm):
            raise InvalidInputError(
                f"first_sample_depth_mm: expected a finite value, got {self.first_sample_depth_mm}"
            )
        if not abs(self.skew_rad) <= LARGEST_SKEW_RAD:
            raise InvalidInputError(
                f"skew_rad: expected at most {LARGEST_SKEW_RAD:g} either way, got {self.skew_rad}"
            )
        if self.fan is not None and (
            abs(self.angle_rad(np.array([0.0, self.vectors - 1.0]))).max() >= np.pi / 2
            or self.fan.radius_mm + self.first_sample_depth_mm < 0
        ):
            raise InvalidInputError(
                "fan: expected lines within 90 degrees of straight down and samples beyond the apex, got "
                f"{self.vectors} lines from {np.rad2deg(self.fan.first_rad):.1f} degrees, "
                f"{np.rad2deg(self.fan.step_rad):.3g} apart"
            )

    @classmethod
    def of_fan(
        cls,
        vectors: int,
        samples: int,
        sample_spacing_mm: float,
        radius_mm: float,
        angles_rad: tuple[float, float],
        first_sample_depth_mm: float = 0.0,
    ) -> ImageGrid:
        """Grid of a curved array, or with `radius_mm` = 0 of a phased one; P begins at its image's top left.

        Parameters
        ----------
        vectors, samples : int
        sample_spacing_mm : float
            Along the lines.
        radius_mm : float
            Of the array's face.
        angles_rad : tuple of float
            Of the first and of the last line, from straight down and towards growing x.
        first_sample_depth_mm : float
            From the face.
        """
        first, last = angles_rad
        step = (last - first) / max(vectors - 1, 1)
        middle = radius_mm + first_sample_depth_mm + (samples - 1) / 2 * sample_spacing_mm
        fan = FanLines((0.0, 0.0), radius_mm, first, step)
        grid = cls(vectors, samples, middle * step, sample_spacing_mm, first_sample_depth_mm, fan=fan)
        left, top = grid.extent_mm[0]
        return replace(grid, fan=replace(fan, apex_mm=(float(-left), float(-top))))

    def angle_rad(self, vector: npt.ArrayLike) -> FloatArray:
        """Angle of vectors from straight down, towards growing x."""
        at = np.asarray(vector, dtype=float)
        return np.zeros(at.shape) if self.fan is None else self.fan.first_rad + at * self.fan.step_rad

    def mm(self, vector: npt.ArrayLike, sample: npt.ArrayLike) -> FloatArray:
        """Place of samples in P, shape (..., 2), mm; numbers may be fractional."""
        v, s = np.asarray(vector, dtype=float), np.asarray(sample, dtype=float)
        if self.fan is None:
            return np.asarray(
                np.stack(np.broadcast_arrays(v, s, 1.0), axis=-1) @ self.image_from_sample[:2].T
            )
        angle = self.angle_rad(v)
        radius = self.fan.radius_mm + self.first_sample_depth_mm + s * self.sample_spacing_mm
        return np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=-1) + self.fan.apex_mm

    def sample_at(self, place_mm: npt.ArrayLike) -> FloatArray:
        """Fractional vector and sample at places in P, shape (..., 2); the inverse of `mm`."""
        place = np.asarray(place_mm, dtype=float)
        if self.fan is None:
            affine = self.image_from_sample[:2]
            return np.asarray(np.linalg.solve(affine[:, :2], (place - affine[:, 2])[..., None])[..., 0])
        x, y = np.moveaxis(place - self.fan.apex_mm, -1, 0)
        depth = np.hypot(x, y) - self.fan.radius_mm - self.first_sample_depth_mm
        vector = (np.arctan2(x, y) - self.fan.first_rad) / self.fan.step_rad
        return np.stack([vector, depth / self.sample_spacing_mm], axis=-1)

    @property
    def extent_mm(self) -> FloatArray:
        """Least and largest x and y of the samples in P, shape (2, 2), mm."""
        v, s = self.vectors - 1, self.samples - 1
        at = [0.0, v, 0.0, v, 0.0, v]
        places = self.mm(at, [0, 0, s, s, 0, s])
        if self.fan is not None:
            # The lowest point of a fan is straight down, if it has a line there.
            straight = np.clip(-self.fan.first_rad / self.fan.step_rad, 0, v)
            places = np.concatenate([places, self.mm([straight, straight], [0, s])])
        return np.array([places.min(axis=0), places.max(axis=0)])

    @property
    def width_mm(self) -> float:
        """Width of the image; of parallel vectors, from the first to the last, mm."""
        if self.fan is not None:
            return float(np.ptp(self.extent_mm[:, 0]))
        return (self.vectors - 1) * self.vector_pitch_mm

    @property
    def depth_mm(self) -> float:
        """Depth of the last sample along its vector, mm."""
        return self.first_sample_depth_mm + (self.samples - 1) * self.sample_spacing_mm

    @property
    def centre_mm(self) -> FloatArray:
        """The image's centre in P, shape (3,), mm; of a fan, the middle sample of its middle line."""
        return np.append(self.mm((self.vectors - 1) / 2, (self.samples - 1) / 2), 0.0)

    @property
    def corners_mm(self) -> FloatArray:
        """The image's corners in P, clockwise from the top left (of a fan, its box's), shape (4, 3), mm."""
        v, s = self.vectors - 1, self.samples - 1
        corners = self.mm([0, v, v, 0], [0, 0, s, s])
        if self.fan is not None:
            (left, top), (right, bottom) = self.extent_mm
            corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        return np.column_stack([corners, np.zeros(4)])

    @property
    def image_from_sample(self) -> FloatArray:
        """Affine map from (vector, sample, 1) to (x, y, z, 1) in P, mm, shape (4, 3), of parallel vectors.

        Raises
        ------
        InvalidInputError
            If the vectors are a fan's, which no affine map places.
        """
        if self.fan is not None:
            raise InvalidInputError("expected parallel vectors, got a fan's: take its images scan-converted")
        along, beside = np.cos(self.skew_rad / 2), np.sin(self.skew_rad / 2)
        across, down = self.vector_pitch_mm, self.sample_spacing_mm
        return np.array(
            [
                [along * across, beside * down, 0.0],
                [beside * across, along * down, self.first_sample_depth_mm],
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True)
class _Sensor(Generic[Samples]):
    """A sensor's stream. A reading taken at t belongs to image time t + `time_offset_s`."""

    readings: TimedSamples[Samples]
    sensor_from_image: Samples | None = None
    time_offset_s: float = 0.0

    label: ClassVar[str]
    """What messages call the sensor."""

    @property
    def uncalibrated(self) -> str:
        """Message that the sensor's mounting is missing."""
        return f"the {self.label} is not calibrated to the image (its attribute sensor_from_image)"

    def covers(self, frame_time_s: npt.ArrayLike) -> BoolArray:
        """Which frames have a reading."""
        return self.readings.covers(np.asarray(frame_time_s) - self.time_offset_s)

    def world_from_image(self, frame_time_s: npt.ArrayLike) -> Samples:
        """Orientation or pose of the image at each frame time.

        Raises
        ------
        InsufficientDataError
            If the sensor is not calibrated to the image, or does not cover a time.
        """
        if self.sensor_from_image is None:
            raise InsufficientDataError(self.uncalibrated)
        world_from_sensor = self.readings.at(np.asarray(frame_time_s) - self.time_offset_s)
        return world_from_sensor * self.sensor_from_image


@shown
@dataclass(frozen=True)
class OrientationSensor(_Sensor[Rotation]):
    """An orientation sensor's stream. A reading taken at t belongs to image time t + `time_offset_s`."""

    label: ClassVar[str] = "orientation sensor"

    readings: TimedRotations
    accelerometer_m_s2: FloatArray | None = None
    gyroscope_rad_s: FloatArray | None = None
    magnetometer_au: FloatArray | None = None


@shown
@dataclass(frozen=True)
class Tracker(_Sensor[RigidTransform]):
    """A 6-DOF sensor's stream. A reading taken at t belongs to image time t + `time_offset_s`.

    Attributes
    ----------
    image_skew_rad : float
        What a measured calibration of pixels has beyond the rigid `sensor_from_image`, which is the nearest
        to it: its columns and its rows lean towards each other by so much in all, half of it each. Only
        volumes and pictures of the tracker's poses look at it.
    """

    label: ClassVar[str] = "tracker"

    readings: TimedPoses
    image_skew_rad: float = 0.0


@shown
@dataclass(frozen=True)
class Sweep:
    """Frames of one freehand sweep with everything recorded beside them.

    Parameters
    ----------
    frames : Frames, shape (n, grid.vectors, grid.samples)
    grid : ImageGrid
    signal : RFSettings or BModeSettings
        What the samples are.
    frame_time_s : ndarray, shape (n,)
        The image clock, strictly increasing.
    truth : RigidTransform, length n, optional
        ``world_from_image`` of every frame; simulations only.
    probe : str, optional
        Name of probe and preset: everything that shapes the beam.
    orientation : OrientationSensor, optional
        Readings of an orientation sensor.
    tracker : Tracker, optional
        Readings of a position sensor.
    name : str
        For messages and files.
    path : Path, optional
        Of the recording that it was read from.

    Examples
    --------
    >>> frames = np.zeros((3, 8, 40), dtype=np.uint8)
    >>> grid = ImageGrid(vectors=8, samples=40, vector_pitch_mm=0.3, sample_spacing_mm=0.1)
    >>> sweep = Sweep(frames, grid, BModeSettings(dynamic_range_db=60.0), np.arange(3) / 25)
    >>> len(sweep), round(sweep.grid.depth_mm, 3)
    (3, 3.9)
    """

    frames: Frames
    grid: ImageGrid
    signal: RFSettings | BModeSettings
    frame_time_s: FloatArray
    orientation: OrientationSensor | None = None
    tracker: Tracker | None = None
    truth: RigidTransform | None = None
    name: str = "sweep"
    probe: str = ""
    path: Path | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        times = require_increasing(self.frame_time_s, f"{self.name}: frame_time_s")
        object.__setattr__(self, "frame_time_s", times)
        _require_kind(self)
        n, vectors, samples = self.frames.shape
        if (vectors, samples) != (self.grid.vectors, self.grid.samples):
            raise InvalidInputError(
                f"{self.name}: expected frames of shape ({self.grid.vectors}, {self.grid.samples}), "
                f"got ({vectors}, {samples})"
            )
        if times.size != n:
            raise InvalidInputError(f"{self.name}: expected {n} frame times, got {times.size}")
        if self.truth is not None and len(self.truth) != n:
            raise InvalidInputError(f"{self.name}: expected {n} true poses, got {len(self.truth)}")

    def __len__(self) -> int:
        return int(self.frames.shape[0])

    @classmethod
    def from_arrays(
        cls,
        frames: Any,
        *,
        pitch_mm: float | tuple[float, float] | None = None,
        frame_rate_hz: float | None = None,
        frame_time_s: npt.ArrayLike | None = None,
        dynamic_range_db: float | None = None,
        signal: RFSettings | None = None,
        first_row_depth_mm: float = 0.0,
        **others: Any,
    ) -> Sweep:
        """Make a sweep of images that a machine gives without a word about them.

        Parameters
        ----------
        frames : array_like, shape (n, row, column)
            Grey levels as uint8, also in colour, or echoes whose samples run down the rows; read when asked.
        pitch_mm : float or tuple of float
            Distance between columns and between rows; one number of square pixels. Rows of echoes lie as
            `signal` says.
        frame_rate_hz : float
            Or `frame_time_s`, shape (n,).
        dynamic_range_db : float
            Of grey levels, from black to white.
        signal : RFSettings
            Of echoes: how they were sampled.
        first_row_depth_mm : float
        **others
            Fields of `Sweep`: orientation, tracker, truth, name, probe.

        Raises
        ------
        InvalidInputError
            Naming all that is missing, or what cannot be.

        Examples
        --------
        >>> images = np.zeros((5, 40, 8), np.uint8)
        >>> sweep = Sweep.from_arrays(images, pitch_mm=0.2, frame_rate_hz=25.0, dynamic_range_db=60.0)
        >>> sweep.frames[0].shape, sweep.grid.vector_pitch_mm, float(sweep.frame_time_s[-1])
        ((8, 40), 0.2, 0.16)
        """
        read = ImageFrames(frames if hasattr(frames, "shape") else np.asarray(frames))
        n, columns, rows = read.shape
        if frame_time_s is None and frame_rate_hz is not None:
            frame_time_s = np.arange(n) / frame_rate_hz
        kind: RFSettings | BModeSettings | None = signal
        if dynamic_range_db is not None and signal is None and read.dtype == np.uint8:
            kind = BModeSettings(dynamic_range_db)
        of_kind = "dynamic_range_db" if read.dtype == np.uint8 else "signal"
        if pitch_mm is None or frame_time_s is None or kind is None:
            known = {"pitch_mm": pitch_mm, "frame_rate_hz": frame_time_s, of_kind: kind}
            missing = ", ".join(name for name, value in known.items() if value is None)
            raise InvalidInputError(f"arrays do not say, so give {missing}: see docs/howto/pictures.md")
        across, down = np.broadcast_to(np.asarray(pitch_mm, dtype=float), (2,)).tolist()
        if isinstance(kind, RFSettings):
            down = kind.sample_spacing_mm
        grid = ImageGrid(columns, rows, across, down, first_row_depth_mm)
        return cls(read, grid, kind, np.asarray(frame_time_s), **others)

    def facts(self) -> list[tuple[str, object]]:
        """What the sweep shows of itself."""
        n, vectors, samples = self.frames.shape
        time_s, grid = self.frame_time_s, self.grid
        kind = "B-mode"
        if isinstance(self.signal, RFSettings):
            kind = "I/Q" if self.signal.are_complex else "RF"
        rate = f", {(n - 1) / (time_s[-1] - time_s[0]):.4g} frames/s" if n > 1 else ""
        return [
            ("name", self.name),
            ("frames", f"{n} of {vectors} vectors x {samples} samples, {kind}, {self.frames.dtype}"),
            ("time", f"{time_s[0]:.3f} to {time_s[-1]:.3f} s{rate}"),
            ("image", f"{grid.width_mm:.4g} x {grid.depth_mm:.4g} mm"),
            ("orientation readings", self.orientation and len(self.orientation.readings)),
            ("tracker readings", self.tracker and len(self.tracker.readings)),
            ("truth", None if self.truth is None else f"{n} poses"),
            ("probe", self.probe or "not named"),
        ]

    def to_xarray(self) -> Any:
        """All frames as an `xarray.DataArray` over frame, lateral_mm and depth_mm; read into memory.

        Vectors of a fan are at their angle_rad.
        """
        xarray = extra_module("xarray", "notebook", "a labelled array")
        grid, vector = self.grid, np.arange(self.grid.vectors)
        lateral, unit, values = "lateral_mm", "mm", vector * grid.vector_pitch_mm
        if grid.fan is not None:
            lateral, unit, values = "angle_rad", "rad", grid.angle_rad(vector)
        depth_mm = grid.first_sample_depth_mm + np.arange(grid.samples) * grid.sample_spacing_mm
        frames = {"frame": np.arange(len(self)), "time_s": ("frame", self.frame_time_s, {"units": "s"})}
        places = {
            lateral: (lateral, values, {"units": unit}),
            "depth_mm": ("depth_mm", depth_mm, {"units": "mm"}),
        }
        return xarray.DataArray(
            np.stack([np.asarray(self.frames[i]) for i in range(len(self))]),
            coords=frames | places,
            dims=("frame", lateral, "depth_mm"),
            name=self.name,
        )

    def part(self, first: int, stop: int) -> Sweep:
        """The frames from `first` to before `stop` as a sweep of their own, with all sensors' readings.

        Raises
        ------
        InvalidInputError
            If there are no such frames.
        """
        if not 0 <= first < stop <= len(self):
            raise InvalidInputError(
                f"{self.name}: expected a part among frames 0 to {len(self) - 1}, got {first} to {stop - 1}"
            )
        return replace(
            self,
            frames=_FramesPart(self.frames, first, stop),
            frame_time_s=self.frame_time_s[first:stop],
            truth=None if self.truth is None else self.truth[first:stop],
        )

    @property
    def orientation_source(self) -> OrientationSensor | Tracker | None:
        """The orientation sensor, or the tracker where there is none."""
        return self.orientation or self.tracker


def image_orientation(sensor: OrientationSensor | Tracker, frame_time_s: npt.ArrayLike) -> Rotation:
    """Orientation ``world_from_image`` at each frame time, by either kind of sensor."""
    measured = sensor.world_from_image(frame_time_s)
    return measured.rotation if isinstance(measured, RigidTransform) else measured


def _require_kind(sweep: Sweep) -> None:
    """Raise unless samples are complex where the settings say so, and real where they do not."""
    are_complex = np.dtype(sweep.frames.dtype).kind == "c"
    if are_complex != (isinstance(sweep.signal, RFSettings) and sweep.signal.are_complex):
        raise InvalidInputError(
            f"{sweep.name}: expected complex samples (I/Q) with a demodulation_frequency_hz (0: analytic "
            f"signal), real ones without, got {sweep.frames.dtype}"
        )


def _require_positive(settings: object, names: tuple[str, ...]) -> None:
    for name in names:
        value = getattr(settings, name)
        if not (np.isfinite(value) and value > 0):
            raise InvalidInputError(f"{name}: expected a value above zero, got {value}")
