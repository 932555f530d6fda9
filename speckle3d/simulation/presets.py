"""Named sweeps: settings in, sweeps with truth out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.simulation.bath import water_bath
from speckle3d.simulation.beam import BeamTable, Probe, tabulate_beam
from speckle3d.simulation.medium import Medium, TiledMedium, fully_developed, phantom, tissue
from speckle3d.simulation.movement import (
    HandMotion,
    Trajectory,
    frame_times,
    hand_sweep,
    scan_floor,
    stepped_poses,
    turned_about,
    world_from_medium,
)
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.sensors import (
    OrientationModel,
    TrackerModel,
    simulate_orientation,
    simulate_tracker,
    with_noise,
)
from speckle3d.simulation.settings import Preset, SimulatedSweep, SimulationSettings

__all__ = ["Preset", "SimulatedSweep", "SimulationSettings", "simulate"]

_PLANE_FRAMES = 150

_BATH_MM = (320.0, -150.0, -240.0)
"""Place of the bath in the tracker's world, off its axes."""

_MOUNTING_RAD = tuple(np.deg2rad([-0.55, 44.22, -90.37]).tolist())
_MOUNTING_MM = (-270.86, 4.86, -65.08)
"""The mounting of table 3 of TR 303 (Prager et al., 1997), for scans of a plane."""


def simulate(settings: SimulationSettings) -> tuple[SimulatedSweep, ...]:
    """Prepare the sweeps of `settings`: two for `crossed`, one otherwise.

    Nothing but the beam table is computed here (about a second); frames are made when indexed.

    Parameters
    ----------
    settings : SimulationSettings

    Returns
    -------
    tuple of SimulatedSweep

    Examples
    --------
    >>> from speckle3d import SimulationSettings, simulate
    >>> settings = SimulationSettings(preset="phantom", vectors=8, samples=600, frames=5)
    >>> (made,) = simulate(settings)  # doctest: +SKIP
    >>> made.sweep.frames[0].shape  # doctest: +SKIP
    (8, 600)
    """
    seeds = np.random.SeedSequence(settings.seed)
    medium_seed, heading_seed, *sweep_seeds = seeds.spawn(4)
    if settings.preset == "plane":
        return (_plane(settings, medium_seed, heading_seed, sweep_seeds[0]),)
    medium = _MEDIUM[settings.preset](_entropy(medium_seed), settings.length_mm)
    probe = Probe()
    beam = tabulate_beam(probe, attenuation_db_cm_mhz=medium.attenuation_db_cm_mhz)
    heading = np.random.default_rng(heading_seed).uniform(-np.pi, np.pi)
    world = world_from_medium(float(heading))
    if settings.preset == "stepped":
        return (_stepped(settings, beam, medium, world, sweep_seeds[0]),)
    count = 2 if settings.preset == "crossed" else 1
    return tuple(
        _hand_held(settings, beam, medium, world, seed, number)
        for number, seed in enumerate(sweep_seeds[:count])
    )


_MEDIUM = {
    "phantom": phantom,
    "tissue": tissue,
    "reversal": tissue,
    "rotation": phantom,
    "crossed": tissue,
    "stepped": fully_developed,
}


def _image(settings: SimulationSettings, probe: Probe) -> ImageGrid:
    return ImageGrid(settings.vectors, settings.samples, probe.pitch_mm, probe.signal.sample_spacing_mm)


def _motion(settings: SimulationSettings) -> HandMotion:
    motion = HandMotion(drift_mm=settings.drift_mm, reverse=_comes_back(settings))
    if settings.preset == "crossed":
        fan = float(np.deg2rad(settings.fan_deg))
        return replace(motion, start_rad=(-fan / 2.0, 0.0, 0.0), turn_rad=(fan, 0.0, 0.0))
    if settings.preset != "rotation":
        return motion
    turn = float(np.deg2rad(settings.turn_deg))
    return replace(motion, turn_rad=(turn, 0.0, 0.0) if settings.turn_axis == "tilt" else (0.0, turn, 0.0))


def _comes_back(settings: SimulationSettings) -> bool:
    return settings.preset == "reversal" or (settings.preset == "rotation" and settings.reverse)


def _hand_held(
    settings: SimulationSettings,
    beam: BeamTable,
    medium: TiledMedium,
    world: RigidTransform,
    seed: np.random.SeedSequence,
    number: int,
) -> SimulatedSweep:
    motion_seed, clock_seed, *others = seed.spawn(5)
    frames = settings.frames or round(8 * settings.length_mm * (2 if _comes_back(settings) else 1))
    image = _image(settings, beam.probe)
    times = frame_times(frames, settings.frame_rate_hz, np.random.default_rng(clock_seed))
    duration = frames / settings.frame_rate_hz
    centre = np.array([image.width_mm / 2.0, 0.0, settings.length_mm / 2.0])
    start = turned_about(centre, float(np.deg2rad(settings.crossing_deg)) * number)
    trajectory = hand_sweep(
        settings.length_mm,
        duration,
        image.width_mm,
        _motion(settings),
        start,
        world,
        np.random.default_rng(motion_seed),
    )
    sensors = TrackerModel(), OrientationModel()
    mounted = settings.preset != "crossed" or not settings.uncalibrated
    name = f"{settings.preset}-{settings.seed}" + ("-crossing" if number else "")
    return _scanned(settings, beam, medium, trajectory, times, duration, sensors, others, mounted, name)


def _plane(
    settings: SimulationSettings,
    medium_seed: np.random.SeedSequence,
    heading_seed: np.random.SeedSequence,
    sweep_seed: np.random.SeedSequence,
) -> SimulatedSweep:
    """Scan of a water bath's floor, its sensors uncalibrated."""
    motion_seed, clock_seed, *others = sweep_seed.spawn(5)
    beam, duration = tabulate_beam(Probe()), settings.duration_s
    frames = settings.frames or _PLANE_FRAMES
    times = frame_times(frames, frames / duration, np.random.default_rng(clock_seed))
    world = _world_from_bath(settings, np.random.default_rng(heading_seed))
    width = _image(settings, beam.probe).width_mm
    scan = scan_floor(settings, width, world, np.random.default_rng(motion_seed))
    tracker = TrackerModel(mounting_rad=_MOUNTING_RAD, mounting_mm=_MOUNTING_MM)
    noise = settings.sensor_noise
    sensors = with_noise(tracker, noise), with_noise(OrientationModel(), noise)
    bath = water_bath(_entropy(medium_seed), settings.reflector)
    name = f"plane-{settings.reflector}-{settings.seed}"
    return _scanned(settings, beam, bath, scan, times, duration, sensors, others, False, name)


def _scanned(
    settings: SimulationSettings,
    beam: BeamTable,
    medium: Medium,
    trajectory: Trajectory,
    times: FloatArray,
    duration_s: float,
    sensors: tuple[TrackerModel, OrientationModel],
    seeds: list[np.random.SeedSequence],
    mounted: bool,
    name: str,
) -> SimulatedSweep:
    """Images and sensors along a trajectory.

    Parameters
    ----------
    seeds : list of SeedSequence
        Of the tracker, the orientation sensor and the electronic noise.
    mounted : bool
        Whether the sweep says how its sensors sit on the probe, or leaves that to a calibration.
    """
    image, span = _image(settings, beam.probe), (-0.3, duration_s + 0.3)
    tracker = simulate_tracker(trajectory, span, sensors[0], np.random.default_rng(seeds[0]))
    orientation = simulate_orientation(trajectory, span, sensors[1], np.random.default_rng(seeds[1]))
    poses = trajectory.medium_from_image(times)
    sweep = Sweep(
        SimulatedFrames(beam, medium, poses, image, settings.snr_db, _entropy(seeds[2])),
        image,
        beam.probe.signal,
        times,
        orientation if mounted else replace(orientation, sensor_from_image=None),
        tracker if mounted else replace(tracker, sensor_from_image=None),
        trajectory.world_from_medium * poses,
        name=name,
    )
    if mounted:
        return SimulatedSweep(sweep, settings)
    return SimulatedSweep(sweep, settings, tracker.sensor_from_image, orientation.sensor_from_image)


def _stepped(
    settings: SimulationSettings,
    beam: BeamTable,
    medium: TiledMedium,
    world: RigidTransform,
    seed: np.random.SeedSequence,
) -> SimulatedSweep:
    image = _image(settings, beam.probe)
    gap = 2.0 * float(beam.elevation_extent_mm.max())
    poses = stepped_poses(settings.steps, settings.step_mm, settings.blocks, gap)
    times = np.arange(len(poses)) / settings.frame_rate_hz
    sweep = Sweep(
        SimulatedFrames(beam, medium, poses, image, settings.snr_db, _entropy(seed)),
        image,
        beam.probe.signal,
        times,
        truth=world * poses,
        name=f"stepped-{settings.seed}",
    )
    return SimulatedSweep(sweep, settings)


def _entropy(seed: np.random.SeedSequence) -> int:
    return int(seed.generate_state(1, np.uint64)[0])


def _world_from_bath(settings: SimulationSettings, rng: np.random.Generator) -> RigidTransform:
    heading, towards = rng.uniform(-np.pi, np.pi, 2)
    slope = np.deg2rad(settings.floor_slope_deg) * np.array([np.cos(towards), 0.0, np.sin(towards)])
    level = RigidTransform.from_translation(_BATH_MM) * world_from_medium(float(heading))
    return level * RigidTransform.from_rotation(Rotation.from_rotvec(slope))
