"""Readings of one stretch without a pause, ready for the filter, and what is found of them."""

from __future__ import annotations

from dataclasses import dataclass

from speckle3d.core.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Samples:
    """Samples of one stretch without a pause.

    Attributes
    ----------
    step_s : ndarray, shape (m,)
        Time from the sample before to each sample; the first is a usual step.
    rate_rad_s, force_m_s2 : ndarray, shape (m, 3)
        Gyroscope and accelerometer, finite.
    field_au : ndarray, shape (m, 3)
        Magnetometer; rows may be NaN.
    lost_rad2 : ndarray, shape (m,)
        Variance of the turn about each axis over lost readings before each sample.
    """

    step_s: FloatArray
    rate_rad_s: FloatArray
    force_m_s2: FloatArray
    field_au: FloatArray
    lost_rad2: FloatArray

    def __len__(self) -> int:
        return int(self.step_s.size)

    def __getitem__(self, part: slice) -> Samples:
        return Samples(*(values[part] for values in vars(self).values()))


@dataclass(frozen=True)
class Estimate:
    """Orientation of one stretch, a row per sample.

    Attributes
    ----------
    xyzw : ndarray, shape (m, 4)
        World from sensor, scalar last.
    sd_rad : ndarray, shape (m, 3)
        About the world's axes.
    bias_rad_s : ndarray, shape (m, 3)
    disturbed, resting : ndarray of bool, shape (m,)
    field_stray, field_iron : ndarray, shape (m,)
        As `xsens.fusion.heading.Headings` has them; NaN where no field tells the heading.
    """

    xyzw: FloatArray
    sd_rad: FloatArray
    bias_rad_s: FloatArray
    disturbed: BoolArray
    resting: BoolArray
    field_stray: FloatArray
    field_iron: FloatArray
