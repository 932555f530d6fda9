"""A sweep: frames read lazily, their grid and clock, and the recorded sensors."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import AnyArray, BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import require_increasing
from speckle3d.core.grid import ImageGrid, ScanConversion, require_positive
from speckle3d.core.images import USUAL_PIXEL_MM, ImageFrames, any_thread, estimate_dynamic_range
from speckle3d.core.streams import Samples, TimedPoses, TimedRotations, TimedSamples
from speckle3d.core.text import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INERTIAL = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")
"""Vectors that an orientation sensor may measure beside its orientation, each of shape (m, 3)."""


class Frames(Protocol):
    """Frames on disk or in memory; indexing reads one."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Sample type: int16, float32, uint8 for B-mode, or complex64 for I/Q and analytic data."""

    def __getitem__(self, index: int) -> AnyArray:
        """Read one frame, shape (vector, sample)."""


def stored_dtype(frames: Frames) -> np.dtype[Any]:
    """Type that frames are stored as: int16 for complex ones that say so by ``stored_dtype``, else their own.

    Pairs of int16 (I/Q) are read as complex64, and would take twice the room so.
    """
    own: np.dtype[Any] = np.dtype(frames.dtype)
    pairs = own.kind == "c" and getattr(frames, "stored_dtype", own) == np.int16
    return np.dtype(np.int16) if pairs else own


_READING = threading.RLock()


class _FramesPart:
    """Part of some frames, from `first` to before `stop`, read one at a time, on any thread.

    Those that do not say ``any_thread = True`` may reuse their memory or hold a place in a file: each is read
    while no other is, and copied.
    """

    any_thread = True

    def __init__(self, frames: Frames, first: int, stop: int) -> None:
        self.frames, self.first, self.shape = frames, first, (stop - first, *frames.shape[1:])
        self.dtype, self.stored_dtype = np.dtype(frames.dtype), stored_dtype(frames)

    def __getitem__(self, index: int) -> AnyArray:
        number = self.first + range(self.shape[0])[index]
        if any_thread(self.frames):
            return self.frames[number]
        with _READING:
            return np.array(self.frames[number])


@dataclass(frozen=True)
class RFSettings:
    """Sampling of radio-frequency vectors or their I/Q.

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
        require_positive(self, ("sampling_rate_hz", "speed_of_sound_m_s", "centre_frequency_hz"))
        low, high = self.bandwidth_hz
        middle, half = self.demodulation_frequency_hz, self.sampling_rate_hz / 2
        # I/Q hold as much on either side of the frequency they were shifted down by, the analytic signal
        # all up to the sampling rate.
        least, most = (middle - half, middle + half) if middle else (0, 2 * half if middle == 0 else half)
        if not (0 < low < high and least <= low and high <= most and (middle or 0) >= 0):
            raise InvalidInputError(
                f"bandwidth_hz: expected 0 < low < high from {least:g} to {most:g}, as sampled, and a "
                f"demodulation_frequency_hz of zero or above, got ({low:g}, {high:g}) and {middle}"
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
        rate_hz, middle_hz = self.sampling_rate_hz, self.demodulation_frequency_hz
        frequencies = np.fft.fftfreq if self.are_complex else np.fft.rfftfreq
        frequency = frequencies(length, 1 / rate_hz)
        return np.asarray(frequency + middle_hz if middle_hz else frequency % rate_hz, dtype=float)


@dataclass(frozen=True)
class BModeSettings:
    """Log compression of grey levels: full scale is 0 dB, zero is `-dynamic_range_db`.

    Attributes
    ----------
    dynamic_range_sigma_db : float
        Standard deviation of the range where it is estimated from speckle; 0 where it is given.
    """

    dynamic_range_db: float
    full_scale: float = 255.0
    dynamic_range_sigma_db: float = 0.0

    def __post_init__(self) -> None:
        require_positive(self, ("dynamic_range_db", "full_scale"))


@dataclass(frozen=True)
class _Sensor(Generic[Samples]):
    """A sensor's stream. A reading taken at t belongs to image time t + `time_offset_s`."""

    readings: TimedSamples[Samples]
    sensor_from_image: Samples | None = None
    time_offset_s: float = 0.0

    label = "sensor"
    """What messages call the sensor."""

    @property
    def uncalibrated(self) -> str:
        """Message that the sensor's mounting is missing."""
        return f"the {self.label} is not calibrated to the image: give --calibration (speckle3d calibrate)"

    def covers(self, frame_time_s: npt.ArrayLike) -> BoolArray:
        """Mask of frames with a reading."""
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

    label = "orientation sensor"

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

    label = "tracker"

    readings: TimedPoses
    image_skew_rad: float = 0.0


@shown
@dataclass(frozen=True)
class Sweep:
    """Frames of one freehand sweep with their metadata and sensor streams.

    Parameters
    ----------
    frames : Frames, shape (n, grid.vectors, grid.samples)
        May be read on any thread.
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
        shape = times.size, self.grid.vectors, self.grid.samples
        if self.frames.shape != shape or (self.truth is not None and len(self.truth) != shape[0]):
            raise InvalidInputError(
                f"{self.name}: expected frames of shape {shape} by times and grid, and as many true poses "
                f"if any, got {self.frames.shape}"
            )
        if not any_thread(self.frames):
            object.__setattr__(self, "frames", _FramesPart(self.frames, 0, len(self)))
        are_complex = np.dtype(self.frames.dtype).kind == "c"
        if are_complex != (isinstance(self.signal, RFSettings) and self.signal.are_complex):
            raise InvalidInputError(
                f"{self.name}: expected complex samples (I/Q) with a demodulation_frequency_hz (0: analytic "
                f"signal), real ones without, got {self.frames.dtype}"
            )

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
        """Make a sweep of bare images and their metadata.

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
            Of grey levels, from black to white; estimated from their speckle if not given.
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
        if frame_time_s is None and frame_rate_hz is not None and frame_rate_hz > 0.0:
            frame_time_s = np.arange(n) / frame_rate_hz
        across, down = np.broadcast_to(USUAL_PIXEL_MM if pitch_mm is None else pitch_mm, (2,)).tolist()
        kind: Any = signal
        if signal is None and read.dtype == np.uint8:
            range_db: Any = dynamic_range_db, 0.0
            if dynamic_range_db is None:
                range_db = estimate_dynamic_range(read, across, down)
            kind = range_db and BModeSettings(range_db[0], dynamic_range_sigma_db=range_db[1])
        stated = {
            "pitch_mm": pitch_mm,
            "frame_rate_hz above zero": frame_time_s,
            "dynamic_range_db or signal": kind,
        }
        missing = ", ".join(name for name, value in stated.items() if value is None)
        if missing:
            raise InvalidInputError(f"arrays do not say, so give {missing}: see docs/howto/pictures.md")
        if isinstance(kind, RFSettings):
            down = kind.sample_spacing_mm
        grid = ImageGrid(columns, rows, across, down, first_row_depth_mm)
        return cls(read, grid, kind, np.asarray(frame_time_s), **others)

    def to_xarray(self) -> Any:
        """All frames as an `xarray.DataArray` over frame, lateral_mm and depth_mm, read into memory.

        Vectors of a fan are at their angle_rad.
        """
        xarray = extra_module("xarray", "notebook", "a labelled array")
        grid, vector = self.grid, np.arange(self.grid.vectors)
        name = "lateral_mm" if grid.fan is None else "angle_rad"
        across = grid.mm(vector, 0)[:, 0] if grid.fan is None else grid.angle_rad(vector)
        depth_mm = grid.first_sample_depth_mm + np.arange(grid.samples) * grid.sample_spacing_mm
        return xarray.DataArray(
            np.stack([self.frames[i] for i in range(len(self))]),
            {"time_s": ("frame", self.frame_time_s), name: across, "depth_mm": depth_mm},
            ("frame", name, "depth_mm"),
            name=self.name,
        )

    def plot(self, frame: int | None = None) -> Figure:
        """Draw a frame, by default the middle one: echoes in dB, B-mode as it is, a fan scan converted."""
        from matplotlib import pyplot
        from scipy.signal import hilbert

        number, grid = len(self) // 2 if frame is None else range(len(self))[frame], self.grid
        image, label = np.asarray(self.frames[number]), "grey level"
        if not isinstance(self.signal, BModeSettings):
            echo = np.abs(image if np.iscomplexobj(image) else hilbert(image.astype(np.float32)))
            # Down to -60 dB.
            image = 20 * np.log10(np.maximum(echo / (echo.max() or 1.0), 1e-3))
            label = "dB below the maximum"
        if grid.fan is not None:
            picture = ScanConversion(grid)
            image, grid = picture(image), picture.grid
        figure, axes = pyplot.subplots(figsize=(5.0, 5.0), layout="constrained")
        pyplot.close(figure)  # it is shown by whom it is returned to, once
        (left, top), (right, bottom) = grid.extent_mm
        drawn = axes.imshow(image.T, cmap="gray", extent=(left, right, bottom, top))
        axes.set(xlabel="lateral / mm", ylabel="depth / mm", title=f"{self.name}, frame {number}")
        figure.colorbar(drawn, label=label, shrink=0.7)
        return figure

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


def image_orientation(sensor: OrientationSensor | Tracker, frame_time_s: npt.ArrayLike) -> Rotation:
    """Orientation ``world_from_image`` at each frame time, by either kind of sensor."""
    measured = sensor.world_from_image(frame_time_s)
    return measured.rotation if isinstance(measured, RigidTransform) else measured
