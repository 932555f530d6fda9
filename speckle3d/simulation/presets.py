"""Named sweeps: settings in, sweeps with truth out."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import SeedSequence, default_rng
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import Sweep
from speckle3d.core.text import shown
from speckle3d.simulation.bath import crossed_threads, water_bath
from speckle3d.simulation.beam import BeamTable, Probe, tabulate_beam
from speckle3d.simulation.medium import TiledMedium, fully_developed, phantom, tissue
from speckle3d.simulation.movement import (
    calibration_scan,
    hand_sweep,
    stepped_poses,
    world_from_medium,
)
from speckle3d.simulation.receiver import received
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.sensors import (
    ORIENTATION_FROM_IMAGE,
    TRACKER_FROM_IMAGE,
    simulate_orientation,
    simulate_tracker,
)
from speckle3d.simulation.settings import SimulationSettings

_FRAME_JITTER_S = 1e-3
"""Of the frame clock, at most, either way."""

_BATH_FRAMES = 150

_BATH_MM = (320.0, -150.0, -240.0)
"""Place of the bath in the tracker's world, off its axes."""

_TISSUE = ("tissue", "reversal", "crossed")
_BATH = ("plane", "wires")


@shown
@dataclass(frozen=True)
class SimulatedSweep:
    """A sweep whose frames are computed as they are read, and the settings that determine it.

    Parameters
    ----------
    sweep : Sweep
    settings : SimulationSettings
    """

    sweep: Sweep
    settings: SimulationSettings

    def description(self) -> dict[str, Any]:
        """Plain values for a file: the settings and, where it is for a calibration to find, the mounting."""
        values, tracker = self.settings.model_dump(mode="json"), self.sweep.tracker
        if tracker is not None and tracker.sensor_from_image is None:
            values["tracker_sensor_from_image"] = TRACKER_FROM_IMAGE.as_matrix().tolist()
            wxyz = ORIENTATION_FROM_IMAGE.as_quat(scalar_first=True).tolist()
            values["orientation_sensor_from_image_wxyz"] = wxyz
        return values


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
    medium_seed, heading_seed, *sweep_seeds = SeedSequence(settings.seed).spawn(4)
    world = world_from_medium(default_rng(heading_seed).uniform(-np.pi, np.pi))
    if settings.preset in _BATH:
        world = RigidTransform.from_translation(_BATH_MM) * world
    medium = _medium(settings, _entropy(medium_seed))
    beam = tabulate_beam(attenuation_db_cm_mhz=medium.attenuation_db_cm_mhz)
    return tuple(
        _sweep(settings, beam, medium, world, sweep_seeds[number], number)
        for number in range(1 + (settings.preset == "crossed"))
    )


def _medium(settings: SimulationSettings, entropy: int) -> TiledMedium:
    if settings.preset == "plane":
        return water_bath(entropy, settings.reflector)
    if settings.preset == "wires":
        return crossed_threads(entropy)
    if settings.preset == "stepped":
        return fully_developed(entropy)
    return (tissue if settings.preset in _TISSUE else phantom)(entropy, settings.length_mm)


def _entropy(seed: SeedSequence) -> int:
    return int(seed.generate_state(1, np.uint64)[0])


def _sweep(
    settings: SimulationSettings,
    beam: BeamTable,
    medium: TiledMedium,
    world: RigidTransform,
    seed: SeedSequence,
    number: int,
) -> SimulatedSweep:
    """Sweep `number` of a preset: images and sensors along a trajectory of its own."""
    in_bath, image = settings.preset in _BATH, _image_grid(settings, beam.probe)
    sensors: dict[str, Any] = {}
    if settings.preset == "stepped":
        gap_mm = 2.0 * beam.extent_mm[1]
        poses = stepped_poses(settings.steps, settings.step_mm, settings.blocks, gap_mm)
        times = np.arange(len(poses)) / settings.frame_rate_hz
    else:
        *seeds, seed = seed.spawn(5)
        motion, clock, tracker, orientation = map(default_rng, seeds)
        per_mm = 16 if settings.preset == "reversal" else 8
        frames = settings.frames or (_BATH_FRAMES if in_bath else round(per_mm * settings.length_mm))
        duration_s = settings.duration_s if in_bath else frames / settings.frame_rate_hz
        rate_hz = frames / duration_s
        jitter_s = min(_FRAME_JITTER_S, 0.2 / rate_hz)
        times = np.arange(frames) / rate_hz + clock.uniform(-jitter_s, jitter_s, frames)
        if in_bath:
            trajectory = calibration_scan(settings, image.width_mm, world, motion)
        else:
            trajectory = hand_sweep(settings, duration_s, image.width_mm, world, motion, number)
        poses, span = trajectory.medium_from_image(times), (-0.3, duration_s + 0.3)
        noise = settings.sensor_noise if in_bath else 1.0
        sensors = {
            "tracker": simulate_tracker(trajectory, span, tracker, noise),
            "orientation": simulate_orientation(trajectory, span, orientation, noise),
        }
        if in_bath or settings.uncalibrated:
            sensors = {name: replace(sensor, sensor_from_image=None) for name, sensor in sensors.items()}
    rf = SimulatedFrames(beam, medium, poses, image, settings.snr_db, _entropy(seed))
    reflector = f"-{settings.reflector}" if settings.preset == "plane" else ""
    name = f"{settings.preset}{reflector}-{settings.seed}" + "-crossing" * number
    sweep = Sweep(rf, image, beam.probe.signal, times, truth=world * poses, name=name, **sensors)
    if settings.signal != "rf":
        range_db = settings.dynamic_range_db if settings.signal == "bmode" else None
        sweep = received(sweep, range_db, decimation=settings.decimation)
    return SimulatedSweep(sweep, settings)


def _image_grid(settings: SimulationSettings, probe: Probe) -> ImageGrid:
    """Grid of parallel vectors, one at each element, or of a fan of vectors."""
    spacing_mm = probe.signal.sample_spacing_mm
    if settings.array == "linear":
        return ImageGrid(settings.vectors, settings.samples, probe.pitch_mm, spacing_mm)
    half = float(np.deg2rad(settings.sector_deg)) / 2
    radius_mm = settings.radius_mm * (settings.array == "curved")
    return ImageGrid.of_fan(settings.vectors, settings.samples, spacing_mm, radius_mm, (-half, half))
