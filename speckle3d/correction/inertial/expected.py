"""What length error to expect of an accelerometer and a gyroscope, before anyone scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.correction.inertial.problem import (
    GRAVITY_M_S2,
    ImageSteps,
    InertialProblem,
    Readings,
)
from speckle3d.correction.inertial.readings import LEAST_HZ
from speckle3d.correction.inertial.scale import expected_error, knot_hz, prior_of
from speckle3d.correction.inertial.settings import InertialSettings

_DRAWS = 3
"""Motions whose variances are averaged: they differ in where wobble, tremor and turns happen to meet."""
_TREMOR_HZ = (8.0, 12.0)
_SINES = 12
_MARGIN_S = 0.2


class InertialPlan(BaseModel):
    """A sensor, a scanner, and how the probe is to be moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gyroscope_deg_s_rthz: float = Field(
        0.085, gt=0, description="Noise density of the gyroscope, degrees/s over the root of Hz."
    )
    accelerometer_m_s2_rthz: float = Field(
        0.002, gt=0, description="Noise density of the accelerometer, m/s^2 over the root of Hz."
    )
    sensor_rate_hz: float = Field(100.0, ge=LEAST_HZ, le=2000, description="Readings a second.")
    frame_rate_hz: float = Field(25.0, ge=5, le=500, description="Frames a second.")
    step_error_mm: float = Field(0.005, gt=0, description="Error of the images' steps that is constant.")
    step_error_share: float = Field(0.02, ge=0, description="Error of the images' steps over their size.")
    lever_mm: float = Field(120.0, ge=0, description="Distance of the sensor above the image's centre.")
    length_mm: float = Field(24.0, gt=0, description="Length of the sweep.")
    duration_s: float = Field(10.0, ge=2, le=120, description="Duration of the sweep.")
    wobble_mm: float = Field(0.5, ge=0, le=5, description="Amplitude of the deliberate to and fro.")
    wobble_hz: float = Field(3.0, gt=0, le=8, description="Its frequency.")
    tremor_mm: float = Field(0.012, ge=0, description="Tremor of a hand, standard deviation.")
    tremor_deg: float = Field(0.016, ge=0, description="Tremor of its turns, standard deviation.")


@dataclass(frozen=True)
class ExpectedError:
    """Standard deviations to expect.

    Attributes
    ----------
    length : float
        Of the length, relative.
    lever_mm, clock_s : float
        Of the lever arm along the probe and of the sensor's clock, which are found on the way.
    trusted : bool
        Whether the length would be fully trusted; see `InertialSettings.trusted_sigma`.
    refused : bool
        Whether it would be refused for want of motion.
    """

    length: float
    lever_mm: float
    clock_s: float
    trusted: bool
    refused: bool


def expected_scale_error(
    plan: InertialPlan | None = None, settings: InertialSettings | None = None
) -> ExpectedError:
    """Standard deviation of the length by inertial scale: Fisher information of the same problem.

    Biases need not be given: they are found from the data. What tissue does that follows the probe is not in
    it, nor can it be.

    Parameters
    ----------
    plan : InertialPlan, optional
    settings : InertialSettings, optional

    Examples
    --------
    >>> wobbled = expected_scale_error(InertialPlan(duration_s=4))
    >>> straight = expected_scale_error(InertialPlan(duration_s=4, wobble_mm=0))
    >>> wobbled.length < 0.5 * straight.length
    True
    """
    p, s = plan or InertialPlan(), settings or InertialSettings()
    s = s.model_copy(update={"lever_mm": (0.0, -p.lever_mm, 0.0)})
    found = np.array([_variances(p, s, np.random.default_rng(seed)) for seed in range(_DRAWS)])
    length, lever, clock = np.sqrt(found.mean(axis=0))
    sigma = float(np.hypot(length, s.accelerometer_scale_sigma))
    return ExpectedError(sigma, float(lever), float(clock), sigma <= s.trusted_sigma, sigma > s.largest_sigma)


def _variances(p: InertialPlan, s: InertialSettings, rng: np.random.Generator) -> FloatArray:
    """Of log scale, lever along the probe, and clock."""
    moved = _Motion(p, rng)
    frame_s = np.arange(0.0, p.duration_s, 1.0 / p.frame_rate_hz)
    if frame_s.size < 10:
        raise InsufficientDataError(f"expected at least 10 frames in the sweep, got {frame_s.size}")
    read_s = np.arange(-_MARGIN_S, p.duration_s + _MARGIN_S, 1.0 / p.sensor_rate_hz)
    steps = np.diff(moved.travel_mm(frame_s, 0))
    still = np.zeros((read_s.size, 3))
    turned, spun = moved.turns(read_s, 0), moved.turns(read_s, 2)
    force = 1e-3 * (moved.travel_mm(read_s, 2) - p.lever_mm * spun[:, 0]) + GRAVITY_M_S2 * turned[:, 0]
    root = float(np.sqrt(p.sensor_rate_hz / 2.0))
    readings = Readings(
        read_s,
        force,
        moved.turns(read_s, 1),
        up=still - [0.0, 1.0, 0.0],
        turn_rate_rad_s=still,
        turn_rad_s2=still,
        force_sigma=p.accelerometer_m_s2_rthz * root,
        rate_sigma=float(np.deg2rad(p.gyroscope_deg_s_rthz)) * root,
    )
    sigma = expected_error(steps, p.step_error_mm, p.step_error_share)
    problem = InertialProblem(
        readings, ImageSteps(frame_s, steps, sigma), prior_of(s), knot_hz(read_s, s), 0.1
    )
    found = problem.solve()
    return np.diag(found.covariance)[[0, 4, 2]]


class _Motion:
    """A hand's sweep, and its derivatives."""

    def __init__(self, p: InertialPlan, rng: np.random.Generator) -> None:
        self._p = p
        self._uneven = _waves(rng, (0.1, 0.6), 0.1 * p.length_mm / p.duration_s)
        self._tremor = _waves(rng, _TREMOR_HZ, p.tremor_mm)
        self._turns = [_waves(rng, _TREMOR_HZ, float(np.deg2rad(p.tremor_deg))) for _ in range(2)]
        self._phase = rng.uniform(0.0, 2.0 * np.pi)

    def travel_mm(self, time_s: FloatArray, order: int) -> FloatArray:
        """Elevational position or a derivative of it."""
        p = self._p
        wobble = np.array([[p.wobble_mm], [2.0 * np.pi * p.wobble_hz], [self._phase]])
        steady = p.length_mm / p.duration_s
        even = steady * time_s if order == 0 else np.full(time_s.size, steady if order == 1 else 0.0)
        return even + sum(_summed(wave, time_s, order) for wave in (self._uneven, self._tremor, wobble))

    def turns(self, time_s: FloatArray, order: int) -> FloatArray:
        """Tilt and yaw or a derivative of them, shape (m, 2)."""
        return np.column_stack([_summed(wave, time_s, order) for wave in self._turns])


def _waves(rng: np.random.Generator, band_hz: tuple[float, float], rms: float) -> FloatArray:
    """Amplitudes, angular frequencies and phases of a random smooth function, shape (3, k)."""
    return np.array(
        [
            np.full(_SINES, rms * np.sqrt(2.0 / _SINES)),
            2.0 * np.pi * rng.uniform(*band_hz, _SINES),
            rng.uniform(0.0, 2.0 * np.pi, _SINES),
        ]
    )


def _summed(waves: FloatArray, time_s: FloatArray, order: int) -> FloatArray:
    size, angular, phase = waves
    turned = np.multiply.outer(time_s, angular) + phase + order * np.pi / 2.0
    return np.asarray((size * angular**order * np.sin(turned)).sum(axis=1))
