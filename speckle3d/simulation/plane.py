"""Scans of a plane for calibration: the motion over the floor of a water bath, and the whole sweep.

References
----------
.. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997:
   figures 4 and 7 (the motions that are needed), table 3 (the mounting).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.simulation.bath import water_bath
from speckle3d.simulation.beam import Probe, tabulate_beam
from speckle3d.simulation.movement import (
    HandMotion,
    Trajectory,
    band_noise,
    frame_times,
    hand_knots,
    world_from_medium,
)
from speckle3d.simulation.scan import Receiver, SimulatedFrames
from speckle3d.simulation.sensors import (
    OrientationModel,
    TrackerModel,
    simulate_orientation,
    simulate_tracker,
)
from speckle3d.simulation.settings import SimulatedSweep, SimulationSettings

_FRAMES = 150

_SWINGS = np.array([2.3, 3.7, 2.9, 6.5, 1.6, 4.3])
"""Swings during the scan of the columns of `FloorScan`: incommensurate, so that each is met with all of the
others."""

_ROAMING_MM = 15.0
"""How far either way the probe wanders over the floor."""

_BATH_MM = (320.0, -150.0, -240.0)
"""Where the bath stands in the tracker's world: on no axis of it."""

_MOUNTING_RAD = tuple(np.deg2rad([-0.55, 44.22, -90.37]).tolist())
_MOUNTING_MM = (-270.86, 4.86, -65.08)


@dataclass(frozen=True)
class FloorScan(Trajectory):
    """A motion over a floor at y = 0 of the medium.

    The columns of `knots` are x (mm) of the point of the floor that the image's middle vector meets, its
    depth in the image, its z; then tilt, yaw, roll (rad). Yaw is about the floor's normal and comes first,
    then tilt and roll about the image's own axes, so that the angle to the floor is theirs alone.
    """

    def _start_from_image(self, columns: FloatArray) -> RigidTransform:
        x, depth, z, tilt, yaw, roll = np.moveaxis(columns, -1, 0)
        rotation = Rotation.from_euler("YXZ", np.stack([yaw, tilt, roll], axis=-1))
        below = self.pivot_mm + np.multiply.outer(depth, [0.0, 1.0, 0.0])
        met = np.stack([x, np.zeros_like(x), z], axis=-1)
        return RigidTransform.from_components(met - rotation.apply(below), rotation)


def scan_floor(
    settings: SimulationSettings, face_mm: float, world: RigidTransform, rng: np.random.Generator
) -> FloorScan:
    """Turn and lift the probe over the whole ranges of `settings`, all at once, as a hand would."""
    duration, tremor = settings.duration_s, HandMotion()
    time = hand_knots(duration)
    nearest, farthest = settings.depth_range_mm
    turns = np.deg2rad([settings.tilt_range_deg, settings.yaw_range_deg, settings.roll_range_deg])
    reach = np.array([_ROAMING_MM, (farthest - nearest) / 2.0, _ROAMING_MM, *turns])
    columns = np.empty((time.size, 6))
    for axis in range(6):
        fast = tremor.tremor_mm if axis < 3 else tremor.tremor_rad
        columns[:, axis] = reach[axis] * _swings(time / duration, _SWINGS[axis], rng)
        columns[:, axis] += fast * band_noise(time, tremor.tremor_band_hz, rng)
    columns[:, 1] += (nearest + farthest) / 2.0
    pivot = np.array([face_mm / 2.0, 0.0, 0.0])
    return FloorScan(time, columns, pivot, RigidTransform.identity(), world)


def simulate_plane(
    settings: SimulationSettings,
    medium_seed: np.random.SeedSequence,
    heading_seed: np.random.SeedSequence,
    sweep_seed: np.random.SeedSequence,
) -> SimulatedSweep:
    """Prepare the scan of a plane, its sensors uncalibrated."""
    motion_seed, clock_seed, tracker_seed, orientation_seed, noise_seed = sweep_seed.spawn(5)
    probe = Probe()
    image = ImageGrid(settings.vectors, settings.samples, probe.pitch_mm, probe.signal.sample_spacing_mm)
    frames = settings.frames or _FRAMES
    times = frame_times(frames, frames / settings.duration_s, np.random.default_rng(clock_seed))
    world = _world_from_bath(settings, np.random.default_rng(heading_seed))
    scan = scan_floor(settings, image.width_mm, world, np.random.default_rng(motion_seed))
    span, (tracker_model, orientation_model) = (-0.3, settings.duration_s + 0.3), _sensors(settings)
    tracker = simulate_tracker(scan, span, tracker_model, np.random.default_rng(tracker_seed))
    orientation = simulate_orientation(scan, span, orientation_model, np.random.default_rng(orientation_seed))
    bath = water_bath(int(medium_seed.generate_state(1, np.uint64)[0]), settings.reflector)
    poses = scan.medium_from_image(times)
    noise = int(noise_seed.generate_state(1, np.uint64)[0])
    sweep = Sweep(
        SimulatedFrames(tabulate_beam(probe), bath, poses, image, Receiver(settings.snr_db), noise),
        image,
        probe.signal,
        times,
        replace(orientation, sensor_from_image=None),
        replace(tracker, sensor_from_image=None),
        world * poses,
        name=f"plane-{settings.reflector}-{settings.seed}",
    )
    return SimulatedSweep(
        sweep, settings, tracker_model.sensor_from_image, orientation_model.sensor_from_image
    )


def _swings(phase: FloatArray, count: float, rng: np.random.Generator) -> FloatArray:
    """Swing between -1 and 1 about `count` times per unit of phase, lingering nowhere but not kinked."""
    # Uneven speed, slow against a swing.
    angle = count * rng.uniform(0.95, 1.05) * phase + 0.05 * band_noise(phase, (0.0, 0.5 * count), rng)
    sine = np.sin(2.0 * np.pi * (angle + rng.random()))
    return np.asarray(np.arcsin(0.95 * sine) / np.arcsin(0.95))


def _world_from_bath(settings: SimulationSettings, rng: np.random.Generator) -> RigidTransform:
    heading, towards = rng.uniform(-np.pi, np.pi, 2)
    slope = np.deg2rad(settings.floor_slope_deg) * np.array([np.cos(towards), 0.0, np.sin(towards)])
    level = RigidTransform.from_translation(_BATH_MM) * world_from_medium(float(heading))
    return level * RigidTransform.from_rotation(Rotation.from_rotvec(slope))


def _sensors(settings: SimulationSettings) -> tuple[TrackerModel, OrientationModel]:
    factor = settings.sensor_noise
    tracker = TrackerModel(mounting_rad=_MOUNTING_RAD, mounting_mm=_MOUNTING_MM)
    return tracker.with_noise(factor), OrientationModel().with_noise(factor)
