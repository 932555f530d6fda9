"""Motion of the probe: hand-like trajectories with a pose at any time.

References
----------
.. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997:
   figures 4 and 7 (the motions over a floor that its calibration needs).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.simulation.settings import SimulationSettings

_KNOT_RATE_HZ = 100.0
"""Knots of the trajectory: eight per period of the fastest tremor."""

_LEAD_S = 0.5
"""The trajectory starts and ends this much beyond the frames, for sensors on their own clocks."""

_TREMOR_HZ = (8.0, 12.0)
_TREMOR = np.repeat([0.012, np.deg2rad(0.016)], 3)
"""Physiological tremor: its band, and its standard deviation in each axis, mm and rad."""

_SPEED_VARIATION = 0.3
"""Slow unevenness of a hand's speed: the largest, over the mean."""

_WANDER = np.array([0.5, 0.5, 0.0, *np.deg2rad([0.6, 0.6, 0.6])])
"""Slow wander over a sweep: standard deviation of x, y (mm), tilt, yaw and roll (rad)."""

_PAUSE_S = 0.3
"""How long the hand stops, once in a sweep."""

_SWINGS = np.array([2.3, 3.7, 2.9, 6.5, 1.6, 4.3])
"""Swings of each column during a calibration scan: incommensurate, so that all combinations occur."""

_YAW_ROLL_DEG = (90.0, 11.0)
"""How far either way a calibration scan turns about these axes."""

_LIFT_MM, _LIFT_REACH_MM = 23.0, 11.0
"""Depth of the floor or the crossing in a calibration scan: the mean, and how far either way."""

_ROAMING_MM = 15.0
"""How far either way the probe wanders over the floor."""

_LATERAL_SHARE = 0.35
"""Of the face: how far a point that is kept in the image goes to either side."""

_OFF_POINT_MM = 0.15
"""How far a hand that watches the image misses a point; the focused beam is 0.4 mm to either side."""


@dataclass(frozen=True)
class Movement:
    """A smooth pose of the image in the medium as a function of time.

    Parameters
    ----------
    columns : BSpline
        Three positions (mm), then tilt, yaw, roll (rad), of the middle of the face, by time (s).
    order : str
        Of the turns, as of ``Rotation.from_euler``.
    in_medium : ndarray, shape (3,)
        1 for positions along the medium's axes, 0 for those along the image's, which say where a point of the
        medium is seen.
    face_mm : float
        Width of the image; the probe turns about the middle of its face.
    world_from_medium : RigidTransform
    medium_from_start : RigidTransform
        What positions in the medium count from.
    """

    columns: BSpline[np.float64]
    order: str
    in_medium: FloatArray
    face_mm: float
    world_from_medium: RigidTransform
    medium_from_start: RigidTransform

    def medium_from_image(self, time_s: FloatArray) -> RigidTransform:
        """Pose in the medium at any times within the knots."""
        place, turns = np.split(self.columns(time_s), 2, axis=-1)
        rotation = Rotation.from_euler(self.order, turns[..., ["XYZ".index(axis) for axis in self.order]])
        in_image = [self.face_mm / 2.0, 0.0, 0.0] + place * (1.0 - self.in_medium)
        translation = place * self.in_medium - rotation.apply(in_image)
        return self.medium_from_start * RigidTransform.from_components(translation, rotation)

    def world_from_image(self, time_s: FloatArray) -> RigidTransform:
        """Pose in the world at any times within the knots."""
        return self.world_from_medium * self.medium_from_image(time_s)


def _knot_times(duration_s: float) -> FloatArray:
    knots = round((duration_s + 2 * _LEAD_S) * _KNOT_RATE_HZ) + 1
    return np.linspace(-_LEAD_S, duration_s + _LEAD_S, knots)


def _curves(
    time: FloatArray, slow: Iterable[FloatArray], rng: Generator, lift_mm: float = 0.0
) -> BSpline[np.float64]:
    """Slow motion of the six columns with tremor, the second raised; by quintics, as sensors feel forces."""
    columns = [
        column + tremor * _band_noise(time, _TREMOR_HZ, rng)
        for column, tremor in zip(slow, _TREMOR, strict=True)
    ]
    columns[1] += lift_mm
    spline = make_interp_spline(time, np.stack(columns, axis=1), k=5)
    spline.extrapolate = False
    return spline


def hand_sweep(
    settings: SimulationSettings,
    duration_s: float,
    face_mm: float,
    world: RigidTransform,
    rng: Generator,
    number: int = 0,
) -> Movement:
    """Sweep along the starting image's elevation, as a hand would.

    Parameters
    ----------
    face_mm : float
        Width of the image.
    world : RigidTransform
        Of the medium.
    number : int
        Of crossed sweeps.
    """
    fan, turn, crossing = np.deg2rad([settings.fan_deg, settings.turn_deg, settings.crossing_deg])
    time = _knot_times(duration_s)
    columns = np.zeros((time.size, 6))
    columns[:, 0] = face_mm / 2.0
    columns[:, 2] += _progress(time, duration_s, settings.preset == "reversal", rng) * settings.length_mm
    phase = np.clip(time / duration_s, 0.0, 1.0)
    share = phase * phase * (3.0 - 2.0 * phase)
    if settings.preset == "rotation":
        columns[:, 3 if settings.turn_axis == "tilt" else 4] = share * turn
    elif settings.preset == "crossed":
        columns[:, 3] = (share - 0.5) * fan
    slow = (
        column + wander * _band_noise(time, (0.0, 1.0 / duration_s), rng) if wander > 0 else column
        for column, wander in zip(columns.T, _WANDER, strict=True)
    )
    across = Rotation.from_rotvec([0.0, crossing * number, 0.0])
    # A crossing sweep is turned about the beam axis through the middle of the first.
    centre_mm = np.array([face_mm / 2.0, 0.0, settings.length_mm / 2.0])
    start = RigidTransform.from_components(centre_mm - across.apply(centre_mm), across)
    return Movement(_curves(time, slow, rng), "ZYX", np.ones(3), face_mm, world, start)


def calibration_scan(
    settings: SimulationSettings, face_mm: float, world: RigidTransform, rng: Generator
) -> Movement:
    """Turn and lift the probe, all axes at once, as a hand would.

    Over a floor at y = 0 of the medium (`plane`), the columns are x of the point of the floor that the
    image's middle vector meets, its depth in the image, its z. About a point at the medium's origin
    (`wires`), they are where the point is in the image: lateral from its middle, depth, out of the plane.
    Yaw is about the medium's y and comes first, then tilt and roll about the image's own axes, so that the
    angle to the floor is theirs alone.
    """
    over_floor = settings.preset == "plane"
    across, off = (_ROAMING_MM, _ROAMING_MM) if over_floor else (_LATERAL_SHARE * face_mm, _OFF_POINT_MM)
    reach = [across, _LIFT_REACH_MM, off, *np.deg2rad([settings.tilt_range_deg, *_YAW_ROLL_DEG])]
    time = _knot_times(settings.duration_s)
    swings = (
        size * _swings(time / settings.duration_s, count, rng)
        for size, count in zip(reach, _SWINGS, strict=True)
    )
    curves = _curves(time, swings, rng, _LIFT_MM)
    in_medium = np.array([1.0, 0.0, 1.0]) * over_floor
    return Movement(curves, "YXZ", in_medium, face_mm, world, RigidTransform.identity())


def stepped_poses(steps: int, step_mm: float, blocks: int, gap_mm: float) -> RigidTransform:
    """Exact elevational steps, in blocks far enough apart to show independent speckle, in the medium."""
    z = np.arange(steps) * step_mm + np.arange(blocks)[:, None] * ((steps - 1) * step_mm + gap_mm)
    return RigidTransform.from_translation(np.outer(z.ravel(), [0.0, 0.0, 1.0]))


def world_from_medium(heading_rad: float) -> RigidTransform:
    """World with z up and x north; the medium's depth axis points down, its lateral axis to `heading_rad`."""
    down = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, heading_rad]) * down)


def _progress(time: FloatArray, duration_s: float, reverse: bool, rng: Generator) -> FloatArray:
    """Fraction of the length travelled: zero before the sweep, one (or zero again) after it."""
    inside = (time >= 0.0) & (time <= duration_s)
    duration = float(time[inside][-1])
    speed = 1.0 + _SPEED_VARIATION * np.tanh(_band_noise(time, (0.0, 0.8), rng))
    # In a very short sweep a whole pause would leave no motion at all.
    pause_s = min(_PAUSE_S, 0.2 * duration)
    # At rest for a pause, which begins and ends within a quarter of it.
    away = np.abs(time - rng.uniform(0.15, 0.85) * duration) / pause_s
    speed = np.where(inside, speed * (1.0 - np.clip(3.0 - 4.0 * away, 0.0, 1.0)), 0.0)
    if reverse:
        speed *= np.tanh((duration / 2.0 - time) / 0.25)
    back = -min(speed.clip(max=0.0).sum(), -1e-300)
    speed = np.where(speed > 0.0, speed / speed.clip(0.0).sum(), speed / back)
    # A hand accelerates over about a tenth of a second.
    start = np.hanning(13)[1:-1]
    return np.cumsum(np.convolve(speed, start / start.sum(), mode="same"))


def _band_noise(time: FloatArray, band_hz: tuple[float, float], rng: Generator) -> FloatArray:
    """Random smooth function of unit rms made of a dozen sinusoids in the band."""
    frequency = rng.uniform(*band_hz, 12)
    phase = rng.uniform(0.0, 2.0 * np.pi, 12)
    wave = np.sin(2.0 * np.pi * np.multiply.outer(time, frequency) + phase)
    return np.asarray(wave.sum(axis=1) / np.sqrt(6.0))


def _swings(phase: FloatArray, count: float, rng: Generator) -> FloatArray:
    """Nearly triangular wave between -1 and 1, about `count` periods per unit of phase, with rounded ends."""
    # The speed varies slowly against a swing.
    angle = count * rng.uniform(0.95, 1.05) * phase + 0.05 * _band_noise(phase, (0.0, 0.5 * count), rng)
    sine = np.sin(2.0 * np.pi * (angle + rng.random()))
    return np.asarray(np.arcsin(0.95 * sine) / np.arcsin(0.95))
