"""Poses and inertial readings of hand-held sweeps whose images misjudge distances, without any images.

The motion is the simulator's, with a wobble that may rock the probe; the sensor is, too, at another
place, rate, quality and clock each time. What images do wrong is drawn here, after what was measured on RF
sweeps and beyond it: a common scale, one that changes along the sweep with the tissue, noise of frames and of
steps, a quadrature bias, single wrong steps, runs of the wrong sign, turns that drift.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import OrientationSensor
from speckle3d.simulation.movement import (
    HandMotion,
    Trajectory,
    band_noise,
    frame_times,
    hand_sweep,
    world_from_medium,
)
from speckle3d.simulation.sensors import OrientationModel, simulate_orientation, with_noise

CENTRE_MM = np.array([7.0, 13.0, 0.0])


@dataclass(frozen=True)
class InertialCase:
    """One sweep: what `correct_inertial` is given, and the truth.

    Attributes
    ----------
    log_scale : float
        Of true over seen distances.
    """

    image: RigidTransform
    covariance: np.ndarray
    sensor: OrientationSensor
    time_s: np.ndarray
    truth: RigidTransform
    log_scale: float
    name: str

    @property
    def length_mm(self) -> float:
        """True elevational length."""
        return along(self.truth)


@dataclass(frozen=True)
class Setup:
    """What is the same in the sweeps of a table's row; None is drawn anew for each.

    Attributes
    ----------
    wobble_mm, tremor_mm : float
    follow : float
        Share of the probe's fast motion that the tissue follows.
    """

    wobble_mm: float = 0.0
    wobble_hz: float | None = None
    tremor_mm: float = 0.012
    duration_s: float | None = 10.0
    frame_rate_hz: float | None = None
    follow: float = 0.0
    clean: bool = False


WOBBLE = Setup(wobble_mm=0.5, wobble_hz=3.0)
TREMOR = Setup(tremor_mm=0.05)
WEAK = Setup()


def drawn(setup: Setup, seed: int) -> InertialCase:
    """Case `seed` of a set-up."""
    rng = np.random.default_rng([seed, 3141])
    rate = setup.frame_rate_hz or rng.uniform(20.0, 50.0)
    duration = setup.duration_s or rng.uniform(6.0, 20.0)
    frames = round(rate * duration)
    times = frame_times(frames, rate, rng)
    trajectory = _moved(setup, duration, rng)
    truth = trajectory.world_from_image(times)
    sensor = _sensor(trajectory, duration, rng)
    log_scale = float(rng.normal(0.0, 0.1))
    image = _seen(truth, times, log_scale, setup, rng)
    z = (image[0].inv() * image).apply(CENTRE_MM)[:, 2]
    covariance = np.zeros((frames, 6, 6))
    covariance[:, np.arange(6), np.arange(6)] = 1e-4
    covariance[:, 2, 2] += (0.1 * z) ** 2 + 0.02**2
    return InertialCase(image, covariance, sensor, times, truth, log_scale, f"{setup}-{seed}")


def along(poses: RigidTransform, centre_mm: np.ndarray = CENTRE_MM) -> float:
    """Elevational length: the sum of the signed steps of the image's centre, mm."""
    steps = (poses[:-1].inv() * poses[1:]).apply(centre_mm) - centre_mm
    return float(steps[:, 2].sum())


def _moved(setup: Setup, duration: float, rng: np.random.Generator) -> Trajectory:
    motion = HandMotion(
        tremor_mm=setup.tremor_mm,
        tremor_rad=np.deg2rad(0.016) * rng.uniform(0.5, 3.0),
        wander_rad=np.deg2rad(rng.uniform(0.2, 2.0)),
        pauses=int(rng.integers(0, 3)),
    )
    lean = Rotation.from_euler("xz", rng.uniform(-40.0, 40.0, 2), degrees=True)
    world = world_from_medium(rng.uniform(-np.pi, np.pi)) * RigidTransform.from_rotation(lean)
    length = rng.uniform(15.0, 40.0)
    plain = hand_sweep(length, duration, 14.0, motion, RigidTransform.identity(), world, rng)
    if not setup.wobble_mm:
        return plain
    time = plain.knot_s
    hz = setup.wobble_hz or rng.uniform(2.0, 3.5)
    phase = 2.0 * np.pi * hz * time + rng.uniform(0, 2 * np.pi) + band_noise(time, (0.0, 0.3), rng)
    ends = np.clip(np.minimum(time, duration - time) / 0.5, 0.0, 1.0)
    wave = setup.wobble_mm * (1.0 + 0.2 * np.tanh(band_noise(time, (0.0, 0.5), rng))) * np.sin(phase)
    wave *= ends**2 * (3.0 - 2.0 * ends)
    knots = plain.knots.copy()
    knots[:, 2] += wave
    # A wrist rocks the probe as it moves it: about a point 100 mm away, or less.
    knots[:, 3] += rng.uniform(-0.01, 0.01) * wave
    knots[:, 4] += rng.uniform(-0.005, 0.005) * wave
    return replace(plain, knots=knots)


def _sensor(trajectory: Trajectory, duration: float, rng: np.random.Generator) -> OrientationSensor:
    model = with_noise(OrientationModel(), float(np.exp(rng.uniform(np.log(0.5), np.log(1.5)))))
    lever = (rng.uniform(-30.0, 45.0), rng.uniform(-160.0, -40.0), rng.uniform(-30.0, 30.0))
    rate, offset = float(rng.choice([80.0, 100.0, 120.0, 200.0])), rng.normal(0.0, 0.01)
    # Noise is white in time: a faster sensor has more of it in each reading.
    faster = float(np.sqrt(rate / 100.0))
    model = replace(
        model,
        rate_hz=rate,
        lever_mm=lever,
        mounting_rad=tuple(rng.uniform(-1.0, 1.0, 3)),
        accelerometer_m_s2=model.accelerometer_m_s2 * faster,
        gyroscope_rad_s=model.gyroscope_rad_s * faster,
    )
    sensor = simulate_orientation(trajectory, (-0.3, duration + 0.3), model, rng)
    off = Rotation.from_rotvec(np.deg2rad(0.3) * rng.standard_normal(3))
    believed = model.sensor_from_image * off
    return replace(
        sensor, sensor_from_image=believed, time_offset_s=sensor.time_offset_s + np.clip(offset, -0.02, 0.02)
    )


def _seen(
    truth: RigidTransform, times: np.ndarray, log_scale: float, setup: Setup, rng: np.random.Generator
) -> RigidTransform:
    """Poses as the images have them, the first the identity."""
    relative = truth[:-1].inv() * truth[1:]
    moved = relative.apply(CENTRE_MM) - CENTRE_MM
    step = moved[:, 2]
    if setup.follow:
        slow = gaussian_filter1d(step, 0.25 / float(np.median(np.diff(times))), mode="nearest")
        step = step - setup.follow * (step - slow)
    seen = step * np.exp(-log_scale)
    if not setup.clean:
        n = step.size
        z = np.cumsum(step)
        grid = np.arange(z.min() - 5.0, z.max() + 5.0, 0.1)
        tissue = gaussian_filter1d(rng.standard_normal(grid.size), 10.0)
        tissue *= rng.uniform(0.0, 0.04) / max(float(tissue.std()), 1e-9)
        trend = rng.normal(0.0, 0.02) * np.linspace(-1.0, 1.0, n)
        seen = seen * np.exp(np.interp(z, grid, tissue) + trend)
        noise = rng.uniform(0.003, 0.008)
        seen = seen * (1.0 + rng.uniform(0.005, 0.03) * rng.standard_normal(n))
        seen = seen + noise * np.diff(rng.standard_normal(n + 1)) / 2.0 + noise * rng.standard_normal(n) / 2.0
        quadrature = rng.uniform(0.0, 0.02)
        seen = np.sign(seen) * np.sqrt(seen**2 + quadrature**2 * seen**2 / (seen**2 + 0.02**2))
        wrong = rng.random(n) < 0.01
        seen = np.where(wrong, seen * rng.uniform(0.5, 1.5, n), seen)
        if rng.random() < 0.25:
            at = int(rng.integers(0, n - 20))
            seen[at : at + int(rng.integers(5, 20))] *= -1.0
    moved = moved.copy()
    moved[:, 2] = seen
    moved[:, :2] += 0.003 * rng.standard_normal((len(moved), 2))
    drift = np.column_stack(
        [np.deg2rad(rng.normal(0.0, 0.03, 2)) * np.abs(seen)[:, None], np.zeros(len(moved))]
    )
    turned = relative.rotation * Rotation.from_rotvec(drift)
    pose, poses = RigidTransform.identity(), [RigidTransform.identity()]
    origin = moved + CENTRE_MM - turned.apply(CENTRE_MM)
    for o, r in zip(origin, turned, strict=True):
        pose = pose * RigidTransform.from_components(o, r)
        poses.append(pose)
    return RigidTransform.concatenate(poses)
