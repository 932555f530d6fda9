"""Named sweeps: settings in, sweeps with truth out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid, OrientationSensor, Sweep, Tracker
from speckle3d.simulation.bath import water_bath
from speckle3d.simulation.beam import BeamTable, Probe, tabulate_beam
from speckle3d.simulation.medium import Medium, fully_developed, phantom, tissue
from speckle3d.simulation.movement import (
    HandMotion,
    Trajectory,
    frame_times,
    hand_sweep,
    scan_floor,
    scan_point,
    stepped_poses,
    turned_about,
    world_from_medium,
)
from speckle3d.simulation.receiver import received_as_bmode, received_as_iq
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.sensors import (
    OrientationModel,
    TrackerModel,
    simulate_orientation,
    simulate_tracker,
    with_noise,
)
from speckle3d.simulation.settings import Preset, SimulatedSweep, SimulationSettings
from speckle3d.simulation.wires import crossed_threads

__all__ = ["Preset", "SimulatedSweep", "SimulationSettings", "simulate"]

_PHANTOM_FRAMES = 150

_BATH_MM = (320.0, -150.0, -240.0)
"""Place of the bath in the tracker's world, off its axes."""

_MOUNTING_RAD = tuple(np.deg2rad([-0.55, 44.22, -90.37]).tolist())
_MOUNTING_MM = (-270.86, 4.86, -65.08)
"""The mounting of table 3 of TR 303 (Prager et al., 1997)."""


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
    heading_rng = np.random.default_rng(heading_seed)
    if settings.preset in ("plane", "wires"):
        world = _world_from_bath(settings, heading_rng)
        bath = _in_water(settings, _entropy(medium_seed))
        return (_calibration_scan(_Scene(settings, tabulate_beam(Probe()), bath, world), sweep_seeds[0]),)
    medium = _MEDIUM[settings.preset](_entropy(medium_seed), settings.length_mm)
    beam = tabulate_beam(Probe(), attenuation_db_cm_mhz=medium.attenuation_db_cm_mhz)
    world = world_from_medium(float(heading_rng.uniform(-np.pi, np.pi)))
    scene = _Scene(settings, beam, medium, world)
    if settings.preset == "stepped":
        return (_stepped(scene, sweep_seeds[0]),)
    count = 2 if settings.preset == "crossed" else 1
    return tuple(_hand_held(scene, seed, number) for number, seed in enumerate(sweep_seeds[:count]))


_MEDIUM = {
    "phantom": phantom,
    "tissue": tissue,
    "reversal": tissue,
    "rotation": phantom,
    "crossed": tissue,
    "stepped": fully_developed,
}


@dataclass(frozen=True)
class _Scene:
    """The settings and what they make: the beam, the medium, and its place in the world."""

    settings: SimulationSettings
    beam: BeamTable
    medium: Medium
    world_from_medium: RigidTransform

    @property
    def image(self) -> ImageGrid:
        s, probe = self.settings, self.beam.probe
        return ImageGrid(s.vectors, s.samples, probe.pitch_mm, probe.signal.sample_spacing_mm)

    def sweep(
        self,
        poses: RigidTransform,
        time_s: FloatArray,
        noise: np.random.SeedSequence,
        name: str,
        orientation: OrientationSensor | None = None,
        tracker: Tracker | None = None,
    ) -> Sweep:
        """Sweep whose images have `poses` in the medium, with the seed of its electronic noise."""
        image, snr_db = self.image, self.settings.snr_db
        frames = SimulatedFrames(self.beam, self.medium, poses, image, snr_db, _entropy(noise))
        truth = self.world_from_medium * poses
        rf = Sweep(frames, image, self.beam.probe.signal, time_s, orientation, tracker, truth, name=name)
        return _received(rf, self.settings)


def _received(rf: Sweep, settings: SimulationSettings) -> Sweep:
    if settings.signal == "iq":
        return received_as_iq(rf, settings.demodulation_frequency_hz, settings.decimation)
    if settings.signal == "bmode":
        return received_as_bmode(rf, settings.dynamic_range_db, settings.decimation)
    return rf


def _motion(settings: SimulationSettings) -> HandMotion:
    motion = HandMotion(
        drift_mm=settings.drift_mm,
        reverse=_comes_back(settings),
        wobble_mm=settings.wobble_mm,
        wobble_hz=settings.wobble_hz,
        tremor_mm=settings.tremor_mm,
    )
    if settings.preset == "crossed":
        fan = float(np.deg2rad(settings.fan_deg))
        return replace(motion, start_rad=(-fan / 2.0, 0.0, 0.0), turn_rad=(fan, 0.0, 0.0))
    if settings.preset != "rotation":
        return motion
    turn = float(np.deg2rad(settings.turn_deg))
    return replace(motion, turn_rad=(turn, 0.0, 0.0) if settings.turn_axis == "tilt" else (0.0, turn, 0.0))


def _comes_back(settings: SimulationSettings) -> bool:
    return settings.preset == "reversal" or (settings.preset == "rotation" and settings.reverse)


def _hand_held(scene: _Scene, seed: np.random.SeedSequence, number: int) -> SimulatedSweep:
    settings, face_mm = scene.settings, scene.image.width_mm
    motion_seed, clock_seed, *others = seed.spawn(5)
    frames = settings.frames or round(8 * settings.length_mm * (2 if _comes_back(settings) else 1))
    times = frame_times(frames, settings.frame_rate_hz, np.random.default_rng(clock_seed))
    duration = frames / settings.frame_rate_hz
    centre = np.array([face_mm / 2.0, 0.0, settings.length_mm / 2.0])
    start = turned_about(centre, float(np.deg2rad(settings.crossing_deg)) * number)
    rng = np.random.default_rng(motion_seed)
    motion, world = _motion(settings), scene.world_from_medium
    trajectory = hand_sweep(settings.length_mm, duration, face_mm, motion, start, world, rng)
    sensors = _tracker(settings), OrientationModel()
    name = f"{settings.preset}-{settings.seed}" + ("-crossing" if number else "")
    return _scanned(scene, trajectory, times, duration, sensors, others, not settings.uncalibrated, name)


def _tracker(settings: SimulationSettings) -> TrackerModel:
    if settings.mounting == "published":
        return TrackerModel(mounting_rad=_MOUNTING_RAD, mounting_mm=_MOUNTING_MM)
    return TrackerModel()


def _in_water(settings: SimulationSettings, entropy: int) -> Medium:
    return water_bath(entropy, settings.reflector) if settings.preset == "plane" else crossed_threads(entropy)


def _calibration_scan(scene: _Scene, seed: np.random.SeedSequence) -> SimulatedSweep:
    """Scan of what stands in a water bath, its sensors uncalibrated."""
    settings, duration = scene.settings, scene.settings.duration_s
    motion_seed, clock_seed, *others = seed.spawn(5)
    frames = settings.frames or _PHANTOM_FRAMES
    times = frame_times(frames, frames / duration, np.random.default_rng(clock_seed))
    rng = np.random.default_rng(motion_seed)
    scan_of = scan_floor if settings.preset == "plane" else scan_point
    scan = scan_of(settings, scene.image.width_mm, scene.world_from_medium, rng)
    noise = settings.sensor_noise
    sensors = with_noise(_tracker(settings), noise), with_noise(OrientationModel(), noise)
    what = f"plane-{settings.reflector}" if settings.preset == "plane" else settings.preset
    name = f"{what}-{settings.seed}"
    return _scanned(scene, scan, times, duration, sensors, others, False, name)


def _scanned(
    scene: _Scene,
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
    span = (-0.3, duration_s + 0.3)
    tracker = simulate_tracker(trajectory, span, sensors[0], np.random.default_rng(seeds[0]))
    orientation = simulate_orientation(trajectory, span, sensors[1], np.random.default_rng(seeds[1]))
    poses = trajectory.medium_from_image(times)
    if mounted:
        sweep = scene.sweep(poses, times, seeds[2], name, orientation, tracker)
        return SimulatedSweep(sweep, scene.settings)
    bare = replace(orientation, sensor_from_image=None), replace(tracker, sensor_from_image=None)
    sweep = scene.sweep(poses, times, seeds[2], name, *bare)
    return SimulatedSweep(sweep, scene.settings, tracker.sensor_from_image, orientation.sensor_from_image)


def _stepped(scene: _Scene, seed: np.random.SeedSequence) -> SimulatedSweep:
    settings, gap = scene.settings, 2.0 * float(scene.beam.elevation_extent_mm.max())
    poses = stepped_poses(settings.steps, settings.step_mm, settings.blocks, gap)
    times = np.arange(len(poses)) / settings.frame_rate_hz
    return SimulatedSweep(scene.sweep(poses, times, seed, f"stepped-{settings.seed}"), settings)


def _entropy(seed: np.random.SeedSequence) -> int:
    return int(seed.generate_state(1, np.uint64)[0])


def _world_from_bath(settings: SimulationSettings, rng: np.random.Generator) -> RigidTransform:
    heading, towards = rng.uniform(-np.pi, np.pi, 2)
    slope = np.deg2rad(settings.floor_slope_deg) * np.array([np.cos(towards), 0.0, np.sin(towards)])
    level = RigidTransform.from_translation(_BATH_MM) * world_from_medium(float(heading))
    return level * RigidTransform.from_rotation(Rotation.from_rotvec(slope))
