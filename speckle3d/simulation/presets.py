"""Named sweeps: settings in, sweeps with truth out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.simulation.beam import BeamTable, Probe, tabulate_beam
from speckle3d.simulation.medium import TiledMedium
from speckle3d.simulation.movement import (
    HandMotion,
    frame_times,
    hand_sweep,
    stepped_poses,
    turned_about,
    world_from_medium,
)
from speckle3d.simulation.plane import simulate_plane
from speckle3d.simulation.recipes import MEDIA
from speckle3d.simulation.scan import Receiver, SimulatedFrames
from speckle3d.simulation.sensors import (
    OrientationModel,
    TrackerModel,
    simulate_orientation,
    simulate_tracker,
)
from speckle3d.simulation.settings import Preset, SimulatedSweep, SimulationSettings

__all__ = ["Preset", "SimulatedSweep", "SimulationSettings", "simulate"]


def simulate(settings: SimulationSettings) -> tuple[SimulatedSweep, ...]:
    """Prepare the sweeps of `settings`: two for `crossed`, one otherwise.

    Nothing but the beam table is computed here (about a second); frames are made when indexed.
    """
    seeds = np.random.SeedSequence(settings.seed)
    medium_seed, heading_seed, *sweep_seeds = seeds.spawn(4)
    if settings.preset == "plane":
        return (simulate_plane(settings, medium_seed, heading_seed, sweep_seeds[0]),)
    medium = MEDIA[_MEDIUM[settings.preset]](_entropy(medium_seed), settings.length_mm)
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


_MEDIUM: dict[str, str] = {
    "phantom": "phantom",
    "tissue": "tissue",
    "reversal": "tissue",
    "rotation": "phantom",
    "crossed": "tissue",
    "stepped": "fully_developed",
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
    motion_seed, clock_seed, tracker_seed, orientation_seed, noise_seed = seed.spawn(5)
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
    span = (-0.3, duration + 0.3)
    tracker = simulate_tracker(trajectory, span, TrackerModel(), np.random.default_rng(tracker_seed))
    orientation = simulate_orientation(
        trajectory, span, OrientationModel(), np.random.default_rng(orientation_seed)
    )
    poses = trajectory.medium_from_image(times)
    mounted = settings.preset != "crossed" or not settings.uncalibrated
    sweep = Sweep(
        SimulatedFrames(beam, medium, poses, image, Receiver(settings.snr_db), _entropy(noise_seed)),
        image,
        beam.probe.signal,
        times,
        orientation if mounted else replace(orientation, sensor_from_image=None),
        tracker if mounted else replace(tracker, sensor_from_image=None),
        world * poses,
        name=f"{settings.preset}-{settings.seed}" + ("-crossing" if number else ""),
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
        SimulatedFrames(beam, medium, poses, image, Receiver(settings.snr_db), _entropy(seed)),
        image,
        beam.probe.signal,
        times,
        truth=world * poses,
        name=f"stepped-{settings.seed}",
    )
    return SimulatedSweep(sweep, settings)


def _entropy(seed: np.random.SeedSequence) -> int:
    return int(seed.generate_state(1, np.uint64)[0])
