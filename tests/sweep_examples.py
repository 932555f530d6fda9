"""Small sweeps with everything a sweep may carry."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker

RF = RFSettings(
    sampling_rate_hz=40e6, speed_of_sound_m_s=1540.0, centre_frequency_hz=6e6, bandwidth_hz=(4e6, 8e6)
)


def poses(n, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.normal(0, 5, 3) + np.cumsum(rng.normal(0, 0.1, (n, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.002, (n, 3)), axis=0)) * Rotation.random(rng=rng)
    return RigidTransform.from_components(places, turns)


def rf_sweep(frames=6, vectors=5, samples=40):
    rng = np.random.default_rng(0)
    data = rng.normal(0, 1000, (frames, vectors, samples)).astype(np.int16)
    grid = ImageGrid(vectors, samples, 0.3, RF.sample_spacing_mm, 2.0)
    m = 3 * frames
    return Sweep(
        frames=data,
        grid=grid,
        signal=RF,
        frame_time_s=10.0 + 0.04 * np.arange(frames),
        orientation=OrientationSensor(
            TimedRotations(10.0 + 0.01 * np.arange(m), Rotation.random(m, rng=rng)),
            sensor_from_image=Rotation.random(rng=rng),
            time_offset_s=0.015,
            accelerometer_m_s2=rng.normal(size=(m, 3)),
            gyroscope_rad_s=rng.normal(size=(m, 3)),
        ),
        tracker=Tracker(TimedPoses(10.0 + 0.012 * np.arange(m), poses(m)), poses(1)[0], -0.02),
        truth=poses(frames, seed=1),
        name="example",
    )


class Pairs:
    """I/Q in memory that a scanner recorded as pairs of int16, as a reader's frames give them."""

    dtype = np.dtype(np.complex64)
    stored_dtype = np.dtype(np.int16)

    def __init__(self, pairs):
        self.pairs, self.shape = pairs, pairs.shape[:3]

    def __getitem__(self, index):
        return self.pairs[index].astype(np.float32).view(np.complex64)[..., 0]


def iq_sweep(frames=6):
    rng = np.random.default_rng(0)
    pairs = rng.integers(-32768, 32768, (frames, 5, 40, 2)).astype(np.int16)
    signal = replace(RF, sampling_rate_hz=10e6, demodulation_frequency_hz=6e6)
    plain = rf_sweep(frames)
    grid = replace(plain.grid, sample_spacing_mm=signal.sample_spacing_mm)
    return replace(plain, frames=Pairs(pairs), grid=grid, signal=signal)


def bmode_sweep(frames=4):
    data = np.random.default_rng(0).integers(0, 256, (frames, 6, 9)).astype(np.uint8)
    plain = rf_sweep(frames, 6, 9)
    grid = ImageGrid(6, 9, 0.085, 0.09, 0.0)
    return replace(plain, frames=data, grid=grid, signal=BModeSettings(60.0, 250.0))


def frames_of(sweep):
    """All frames in one array."""
    return np.stack([sweep.frames[i] for i in range(len(sweep))])


def sizes_of(grid):
    """Numbers of a grid of parallel lines."""
    assert grid.fan is None
    return [value for name, value in vars(grid).items() if name != "fan"]
