"""The clock of a tracker, estimated with a plane's calibration: errors against what is claimed of them.

The hand's motion is a sum of swings with the speeds of hands and a tremor, or one kind of motion after the
other; the tracker samples it at 50 Hz with errors that are white, that wander, or both, on a clock that is
regular, irregular, or loses samples. Nothing here interpolates: truth is evaluated at the times themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import Seen
from calibration.recording import Recording
from speckle3d.calibrating.phantoms import solved
from speckle3d.calibrating.settings import PlaneSettings
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.streams import TimedPoses

from .hand import misread
from .rows import Row, trials

TRACKER_HZ = 50.0
RATES_HZ = (25.0, 25.0 / 3.0, 8.85)
"""Of frames: every second sample, every sixth, and nearly that."""

ERRORS = ("white", "drifting", "both")
OF_EACH = 60
DRIFT = (0.3, 0.2, 5.0)
"""Millimetres, degrees and seconds."""
MOST_FRAMES, FEWEST_FRAMES = 300, 60

MOTION = "motion"
"""Refused with the true clock, too: the motion does not determine the calibration."""

LARGEST_Z, WORST_S = 1.2, 0.004


@dataclass(frozen=True)
class Trial:
    """One recording of a plane."""

    seed: int
    frames_hz: float
    errors: str


@dataclass(frozen=True)
class Found:
    """Error and claimed error of the offset, s; `refused` says why there is none."""

    error_s: float
    claimed_s: float
    refused: str = ""


def measure(share: float, first_seed: int) -> list[Row]:
    """Rows of each rate and kind of error."""
    cases = [(rate, errors) for rate in RATES_HZ for errors in ERRORS]
    count = max(3, round(share * OF_EACH))
    todo = [Trial(first_seed + k, rate, errors) for rate, errors in cases for k in range(count)]
    found = trials(run, todo)
    return [
        row_of(rate, errors, found[k * count : (k + 1) * count]) for k, (rate, errors) in enumerate(cases)
    ]


def row_of(rate: float, errors: str, found: list[Found]) -> Row:
    """RMS of the errors over what is claimed, the worst error, and how many were refused for the clock."""
    kept = [each for each in found if not each.refused]
    z = np.array([each.error_s / each.claimed_s for each in kept])
    worst = max((abs(each.error_s) for each in kept), default=np.inf)
    rms = float(np.sqrt(np.mean(z**2))) if kept else np.inf
    off, claimed = (
        1e3 * float(np.sqrt(np.mean(np.square(values)))) if kept else np.inf
        for values in ([each.error_s for each in kept], [each.claimed_s for each in kept])
    )
    motion = sum(each.refused == MOTION for each in found)
    clock = len(found) - len(kept) - motion
    text = (
        f"RMS z {rms:.2f}, RMS {off:.2f} ms claimed {claimed:.2f}, worst {1e3 * worst:.1f} ms, {len(kept)} "
        f"recordings, {clock} refused for the clock, {motion} with the true clock too"
    )
    reached = rms <= LARGEST_Z and worst <= WORST_S and clock == 0
    return Row(f"clock, {rate:.3g} frames/s, errors {errors}", text, "RMS z <= 1.2, worst <= 4 ms", reached)


def run(trial: Trial) -> Found:
    """Simulate a recording and estimate its clock."""
    recording, seen, offset_s = simulate(trial)
    settings = PlaneSettings(fixed_pixels=trial.seed % 2 == 0, reflector="bar")
    try:
        outcome = solved(recording, seen, settings.model_copy(update={"time_offset_s": "estimate"}))
    except Speckle3DError as error:
        try:
            solved(replace(recording, time_offset_s=offset_s), seen, settings)
        except Speckle3DError:
            return Found(np.nan, np.nan, MOTION)
        return Found(np.nan, np.nan, str(error))
    assert outcome.offset is not None
    return Found(outcome.offset.seconds - offset_s, outcome.offset.standard_error_s)


def simulate(trial: Trial) -> tuple[Recording, Seen, float]:
    """A recording of a plane in a bath, and its clock's true offset, s."""
    rng = np.random.default_rng([trial.seed, round(100 * trial.frames_hz)])
    frame_s, number = frame_times(rng, trial.frames_hz)
    offset_s = rng.uniform(-0.2, 0.2)
    hand = Hand(rng, frame_s[-1])
    world_from_floor = RigidTransform.from_components(rng.uniform(-200, 200, 3), Rotation.random(rng=rng))
    sensor_from_image = RigidTransform.from_components(
        rng.uniform(40, 120) * Rotation.random(rng=rng).apply([0.0, 0.0, 1.0]), Rotation.random(rng=rng)
    )
    width_mm, pixel_mm = rng.uniform(30.0, 60.0), rng.uniform(0.08, 0.25, 2)
    pixels = lines_seen(rng, hand.at(frame_s), width_mm, pixel_mm)
    sensor_s = sample_times(rng, frame_s[-1])
    exact = world_from_floor * hand.at(sensor_s) * sensor_from_image.inv()
    white = (rng.uniform(0.1, 0.3), rng.uniform(0.05, 0.15)) if trial.errors != "drifting" else (0.0, 0.0)
    poses = misread(rng, exact, sensor_s, white, DRIFT if trial.errors != "white" else (0.0, 0.0, 5.0))
    stamped_s = sensor_s - offset_s
    images = np.zeros((int(number[-1]) + 1, 2, 2), dtype=np.uint8)
    times = np.arange(len(images)) / trial.frames_hz
    recording = Recording(
        images, pixel_mm * rng.uniform(0.99, 1.01, 2), 0.0, times, TimedPoses(stamped_s, poses)
    )
    return recording, Seen(number, pixels), offset_s


def frame_times(rng: np.random.Generator, frames_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of 60 to 300 frames that show a line, in 10 to 40 s, and their numbers."""
    seconds = rng.uniform(10.0, 40.0)
    number = np.arange(int(seconds * frames_hz))
    most = min(MOST_FRAMES, number.size)
    kept = rng.choice(number, rng.integers(min(FEWEST_FRAMES, most), most + 1), replace=False)
    number = np.sort(kept)
    return number / frames_hz, number


def sample_times(rng: np.random.Generator, last_s: float) -> np.ndarray:
    """Times of the tracker's samples: regular, irregular by a tenth of a period, or with samples missing."""
    phase = rng.uniform(0.0, 1.0 / TRACKER_HZ)
    times = np.arange(phase - 1.0, last_s + 1.0, 1.0 / TRACKER_HZ)
    kind = rng.integers(3)
    if kind == 1:
        times = times + rng.uniform(-0.1, 0.1, times.size) / TRACKER_HZ
    if kind == 2:
        there = rng.random(times.size) > 0.05
        for start in rng.uniform(0.0, last_s, 3):
            there &= (times < start) | (times > start + rng.uniform(0.1, 0.5))
        times = times[there]
    return times


class Hand:
    """Poses of an image over a floor at z = 0, as a function of time."""

    def __init__(self, rng: np.random.Generator, last_s: float) -> None:
        turns = np.deg2rad([rng.uniform(20, 35), rng.uniform(12, 25), rng.uniform(30, 80)])
        reach = np.array([*turns, rng.uniform(6, 12), *rng.uniform(10, 60, 2)])
        self._frequency = 1.0 / rng.uniform(1.5, 8.0, (6, 5))
        self._share = rng.uniform(0.3, 1.0, (6, 5))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (6, 5))
        self._tremor_hz, self._tremor_phase = rng.uniform(5.0, 10.0, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
        self._tremor = np.array([*np.deg2rad([0.03] * 3), *[0.15] * 3]) * rng.standard_normal(6)
        self._in_turn, self._order, self._last_s = bool(rng.integers(2)), rng.permutation(6), last_s
        self._height_mm = rng.uniform(25.0, 45.0)
        widest = np.abs(self._swing(np.linspace(0.0, last_s, 1000))).max(axis=1)
        self._share *= (reach / widest)[:, None]

    def _swing(self, time_s: np.ndarray) -> np.ndarray:
        cycle = 2.0 * np.pi * self._frequency[..., None] * time_s + self._phase[..., None]
        x = np.einsum("ij,ijt->it", self._share, np.sin(cycle))
        if self._in_turn:
            # Each kind of motion has its part of the scan, a quarter of it wide, and less of it elsewhere.
            middle = (self._order[:, None] + 0.5) / 6.0 * self._last_s
            x *= 0.4 + 0.6 * np.exp(-(((time_s - middle) / (0.18 * self._last_s)) ** 2))
        return x

    def at(self, time_s: np.ndarray) -> RigidTransform:
        """Pose of the image."""
        tremor = np.sin(2.0 * np.pi * self._tremor_hz[:, None] * time_s + self._tremor_phase[:, None])
        x = self._swing(time_s) + self._tremor[:, None] * tremor
        down = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        turn = about(2, x[2]) * down * about(2, x[1]) * about(0, x[0])
        height = self._height_mm + x[3]
        return RigidTransform.from_components(np.column_stack([x[4], x[5], height]), turn)


def about(axis: int, angles_rad: np.ndarray) -> Rotation:
    """Turns about one axis."""
    return Rotation.from_rotvec(np.outer(angles_rad, np.eye(3)[axis]))


def lines_seen(
    rng: np.random.Generator, world_from_image: RigidTransform, width_mm: float, pixel_mm: np.ndarray
) -> np.ndarray:
    """Two points of the floor's line in each image, whose depth errs by 0.1 to 0.3 mm, shape (m, 2, 2)."""
    sigma_mm = rng.uniform(0.1, 0.3)
    normal = world_from_image.rotation.inv().apply([0.0, 0.0, 1.0])
    height = world_from_image.translation[:, 2]
    across = np.array([0.0, width_mm])
    depth = -(height[:, None] + normal[:, :1] * across) / normal[:, 1:2]
    depth += sigma_mm * rng.standard_normal(depth.shape)
    return np.stack([np.broadcast_to(across / pixel_mm[0], depth.shape), depth / pixel_mm[1]], axis=-1)
