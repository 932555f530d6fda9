"""Good sweeps as a bench records them, each drawn from its seed: what no check may call bad.

``python tests/benchmarks/corpus.py FOLDER [--first-seed N] [--count N] [--workers 2]`` writes them as
``00.h5`` and so on, with the curves that they are read with.

A third has a tracker, a third an orientation sensor, a third both, each with honest faults: jitter, slow
wander, a mounting known to a third of a degree, a clock known to some milliseconds, a world of its own.
Among them are what plausible checks stumble on: sweeps without any turn, the probe moved the other way,
trackers that lose sight of the probe, few readings a second, a lens whose focus is 10 % off its curves'.
"""

import argparse
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from cache import DEFAULT, key_of
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import ImageGrid, OrientationSensor, Sweep, Tracker
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.simulation.beam import Probe, tabulate_beam
from speckle3d.simulation.medium import phantom, tissue
from speckle3d.simulation.movement import HandMotion, Trajectory, frame_times, hand_sweep
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.sensors import (
    OrientationModel,
    TrackerModel,
    simulate_orientation,
    simulate_tracker,
)

FIRST_SEED = 7001
COUNT = 64
CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"

PRESETS = ("phantom", "tissue", "reversal", "rotation")
SENSORS = ("both", "tracker", "orientation")


@dataclass(frozen=True)
class Good:
    """Settings of one good sweep.

    Parameters
    ----------
    sensors : {"both", "tracker", "orientation"}
    length_mm : float
        Signed: below zero, the probe moves against the image's z.
    covered : tuple of float
        Shares of the sweep between which the tracker has readings.
    inertial : bool
        Whether the orientation sensor gives its gyroscope and accelerometer.
    mounting_error_rad, mounting_error_mm : float
        How well calibrations know where the image is on the sensors, standard deviation per axis.
    clock_error_s : float
        How well the clocks' offset is known.
    scale : float
        Of the tracker's millimetres: field distortion.
    own_world : bool
        Whether the tracker's world is another than the orientation sensor's.
    """

    seed: int
    preset: str
    sensors: str
    length_mm: float
    frames: int
    frame_rate_hz: float
    image: ImageGrid
    probe: Probe
    motion: HandMotion
    tracker: TrackerModel
    orientation: OrientationModel
    covered: tuple[float, float] = (0.0, 1.0)
    inertial: bool = True
    mounting_error_rad: float = 0.0
    mounting_error_mm: float = 0.0
    clock_error_s: float = 0.0
    scale: float = 1.0
    own_world: bool = False

    @property
    def name(self) -> str:
        """What kind of sweep it is, in a few words."""
        words = [self.preset, self.sensors, f"{self.length_mm:.0f} mm"]
        if self.motion.wander_rad < np.deg2rad(0.1):
            words.append("straight")
        if self.covered != (0.0, 1.0) and self.sensors != "orientation":
            words.append(f"tracker {self.covered[0]:.0%} to {self.covered[1]:.0%}")
        if not self.inertial and self.sensors != "tracker":
            words.append("no gyroscope")
        if self.probe != Probe():
            words.append("focus 10 % off")
        return ", ".join(words)


def drawn(number: int, first_seed: int = FIRST_SEED) -> Good:
    """Settings of sweep `number` of those that start with `first_seed`."""
    seed = first_seed + number
    rng = np.random.default_rng([seed, 64])
    preset, sensors = PRESETS[number // 3 % 4], SENSORS[number % 3]
    length = rng.uniform(4.0, 8.0 if preset == "reversal" else 16.0)
    travel = length * (2 if preset == "reversal" else 1)
    frames = int(np.clip(round(travel * rng.uniform(5.0, 11.0)), 30, 120))
    sign = rng.choice([-1.0, 1.0])
    samples, spacing = int(rng.integers(1000, 2001)), Probe().signal.sample_spacing_mm
    depth = rng.uniform(0.0, 34.0 - samples * spacing)
    image = ImageGrid(int(rng.integers(26, 49)), samples, Probe().pitch_mm, spacing, round(depth, 2))
    # One lens in nine focuses 10 % off: its curves are some 15 % wrong at some depths.
    focus = 20.0 * (1.0 if number % 9 != 7 else rng.choice([0.9, 1.1]))
    return Good(
        seed,
        preset,
        sensors,
        sign * length,
        frames,
        float(rng.uniform(15.0, 50.0)),
        image,
        Probe(elevation_focus_mm=focus),
        _motion(number, preset, length, rng),
        TrackerModel(
            rate_hz=rng.uniform(40.0, 120.0),
            position_mm=rng.uniform(0.05, 0.25),
            orientation_rad=np.deg2rad(rng.uniform(0.05, 0.2)),
            latency_s=_offset(number, rng),
            dropouts=0.08 if number % 5 == 2 else 0.0,
            mounting_rad=tuple(rng.uniform(-np.pi, np.pi, 3).tolist()),
            mounting_mm=tuple(rng.uniform(-120.0, 120.0, 3).tolist()),
        ),
        OrientationModel(
            rate_hz=rng.uniform(40.0, 120.0),
            inclination_rad=np.deg2rad(rng.uniform(0.05, 0.2)),
            heading_rad=np.deg2rad(rng.uniform(0.2, 0.7)),
            wander_s=rng.uniform(15.0, 60.0),
            white_rad=np.deg2rad(rng.uniform(0.02, 0.1)),
            time_offset_s=-_offset(number, rng),
            mounting_rad=tuple(rng.uniform(-np.pi, np.pi, 3).tolist()),
            lever_mm=tuple(rng.uniform(-120.0, 120.0, 3).tolist()),
        ),
        # Of those that lose sight of the probe, some for too long to correct by, some not.
        covered=[(0.0, 0.93), (0.05, 0.95), (0.35, 1.0)][number // 9 % 3] if number % 9 == 4 else (0.0, 1.0),
        inertial=number % 4 != 1,
        mounting_error_rad=np.deg2rad(0.33),
        mounting_error_mm=0.5,
        clock_error_s=0.004,
        scale=float(rng.normal(1.0, 0.004)),
        own_world=bool(rng.random() < 0.5),
    )


def _motion(number: int, preset: str, length_mm: float, rng: np.random.Generator) -> HandMotion:
    """A hand, or one sweep in eight a motor that neither turns nor trembles."""
    turn = np.deg2rad(rng.uniform(0.25, 0.6) * length_mm) * rng.choice([-1.0, 1.0])
    axis = int(rng.integers(2))
    turns = tuple(turn * (preset == "rotation" and axis == each) for each in range(3))
    if number % 8 == 6:
        fixed = {"drift_mm": 0.05, "wander_rad": np.deg2rad(0.05), "tremor_mm": 0.002, "tremor_rad": 2e-5}
        return HandMotion(0.05, 0, turn_rad=turns, reverse=preset == "reversal", **fixed)
    return HandMotion(
        speed_variation=rng.uniform(0.1, 0.4),
        pauses=int(rng.integers(0, 3)),
        pause_s=rng.uniform(0.2, 0.5),
        drift_mm=rng.uniform(0.2, 0.8),
        wander_rad=np.deg2rad(rng.uniform(0.25, 0.9)),
        turn_rad=turns,
        tremor_mm=rng.uniform(0.006, 0.015),
        tremor_rad=np.deg2rad(rng.uniform(0.008, 0.02)),
        reverse=preset == "reversal",
    )


def _offset(number: int, rng: np.random.Generator) -> float:
    """Latency of a sensor, or in one of seven the seconds between two computers' clocks."""
    return float(rng.uniform(-300.0, 300.0) if number % 7 == 3 else rng.uniform(-0.05, 0.15))


def made(good: Good) -> Sweep:
    """The sweep of some settings; its frames are computed as they are read."""
    motion, clock, tracking, turning, noise, faults = np.random.SeedSequence(good.seed).spawn(6)
    rng = np.random.default_rng(faults)
    length = abs(good.length_mm)
    medium = (phantom if good.preset in ("phantom", "rotation") else tissue)(good.seed, length)
    start = RigidTransform.from_translation([0.0, 0.0, length if good.length_mm < 0 else 0.0])
    world = RigidTransform.from_components(rng.uniform(-300.0, 300.0, 3), Rotation.random(rng=rng))
    duration = good.frames / good.frame_rate_hz
    width = good.image.width_mm
    trajectory = hand_sweep(
        good.length_mm, duration, width, good.motion, start, world, np.random.default_rng(motion)
    )
    times = frame_times(good.frames, good.frame_rate_hz, np.random.default_rng(clock))
    poses = trajectory.medium_from_image(times)
    beam = tabulate_beam(good.probe, attenuation_db_cm_mhz=medium.attenuation_db_cm_mhz)
    frames = SimulatedFrames(beam, medium, poses, good.image, 40.0, int(noise.generate_state(1)[0]))
    return Sweep(
        frames,
        good.image,
        good.probe.signal,
        times,
        _orientation(good, trajectory, duration, np.random.default_rng(turning), rng),
        _tracker(good, trajectory, duration, np.random.default_rng(tracking), rng),
        world * poses,
        name=f"good-{good.seed}",
    )


def _tracker(
    good: Good, path: Trajectory, duration_s: float, noise: np.random.Generator, rng: np.random.Generator
) -> Tracker | None:
    other = RigidTransform.from_components(rng.uniform(-500.0, 500.0, 3), Rotation.random(rng=rng))
    turn = Rotation.from_rotvec(good.mounting_error_rad * rng.standard_normal(3))
    shift = good.mounting_error_mm * rng.standard_normal(3)
    late = good.clock_error_s * rng.standard_normal()
    if good.sensors == "orientation":
        return None
    seen = (good.covered[0] * duration_s - 0.3, good.covered[1] * duration_s + 0.3)
    if good.covered[0] > 0:
        seen = (good.covered[0] * duration_s, seen[1])
    if good.covered[1] < 1:
        seen = (seen[0], good.covered[1] * duration_s)
    exact = simulate_tracker(path, seen, good.tracker, noise)
    poses = exact.readings.world_from_sensor
    if good.own_world:
        poses = other * poses
    poses = RigidTransform.from_components(good.scale * poses.translation, poses.rotation)
    assert exact.sensor_from_image is not None
    mount = exact.sensor_from_image * RigidTransform.from_components(shift, turn)
    return Tracker(TimedPoses(exact.readings.time_s, poses), mount, exact.time_offset_s + late)


def _orientation(
    good: Good, path: Trajectory, duration_s: float, noise: np.random.Generator, rng: np.random.Generator
) -> OrientationSensor | None:
    turn = Rotation.from_rotvec(good.mounting_error_rad * rng.standard_normal(3))
    late = good.clock_error_s * rng.standard_normal()
    if good.sensors == "tracker":
        return None
    exact = simulate_orientation(path, (-0.3, duration_s + 0.3), good.orientation, noise)
    assert exact.sensor_from_image is not None
    changed: dict[str, Any] = {
        "sensor_from_image": exact.sensor_from_image * turn,
        "time_offset_s": exact.time_offset_s + late,
    }
    if not good.inertial:
        changed |= dict.fromkeys(("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"))
    readings = TimedRotations(exact.readings.time_s, exact.readings.world_from_sensor)
    return replace(exact, readings=readings, **changed)


def good_sweep(number: int, first_seed: int = FIRST_SEED, folder: Path = DEFAULT) -> Path:
    """File of sweep `number`, simulated once and kept by what determines it."""
    good = drawn(number, first_seed)
    path = folder / f"good-{good.seed}-{key_of(repr(good))}.h5"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_sweep(path, made(good))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(CURVES, options.folder / "curves.h5")
    # Spawned, not forked: numba's threads do not survive a fork.
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        waiting = [
            pool.submit(good_sweep, number, options.first_seed, options.cache)
            for number in range(options.count)
        ]
        for number, future in enumerate(waiting):
            path = options.folder / f"{number:02}.h5"
            # Whole or not at all, for those who read while this writes.
            shutil.copy(future.result(), path.with_suffix(".part")).replace(path)
            print(f"{number:02} {drawn(number, options.first_seed).name}", flush=True)


if __name__ == "__main__":
    main()
