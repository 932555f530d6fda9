"""Decorrelation curves of a probe of which nothing was measured but what its data sheet says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves, EchoSpectra, NominalProbe, TiltResponse
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings
from speckle3d.matching.intensity import two_way_wavenumber
from speckle3d.motion.diffraction import (
    BACKSCATTER_EXPONENT,
    SPEED_M_S,
    SUB_DEPTHS,
    band_nodes,
    log_width,
    sheet_spectrum,
    speckle_correlation,
    tilt_pivot,
)

MODEL_SIGMA = 0.025
"""Relative error of all distances by the model itself: its distances are 0.8 % longer to 2.5 % shorter than
those measured on phantoms and tissue that were simulated with a field in three dimensions."""
UNIFORM = 1.0 / np.sqrt(3.0)
"""Standard deviation over half the width of what lies anywhere between two bounds."""
LATERAL_CELL = 1.5
"""Width of a cell of speckle over wavelength times f-number: 0.9 for an even aperture, more for tapered
ones."""
GRID_MM = 0.01
LEAST_AMPLITUDE = 1e-4


class ProbeSheet(BaseModel):
    """A probe as its data sheet and the scanner's settings have it (``probe.toml``)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    elevation_aperture_mm: float = Field(gt=0.5, le=40, description="Height of the elements.")
    elevation_focus_mm: float = Field(gt=2, le=300, description="Depth at which the lens focuses.")
    band_mhz: tuple[float, float] = Field(
        description="Where the pulse-echo spectrum of a reflector on the axis is at -6 dB, low and high."
    )
    attenuation_db_cm_mhz: float = Field(0.5, ge=0, le=3, description="Of the tissue, one way.")
    backscatter_exponent: float = Field(
        BACKSCATTER_EXPONENT,
        ge=-1,
        le=4,
        description="Of scattered power over frequency: soft tissue 0.6 to 1.6.",
    )
    transmit_aperture_mm: float | None = Field(
        None,
        ge=0,
        le=60,
        description="Width of the transmit aperture, which matters near the probe; by default what the "
        "f-number asks for at the lens's focus.",
    )
    f_number: float = Field(2.0, gt=0.5, le=20, description="Of the apertures.")
    focus_tolerance: float = Field(0.15, ge=0, lt=0.5, description="Either way, as a share.")
    aperture_tolerance: float = Field(0.10, ge=0, lt=0.5, description="Either way, as a share.")
    frequency_tolerance: float = Field(
        0.08,
        ge=0,
        lt=0.3,
        description="Of the echo's frequency, either way, as a share; for want of a sweep.",
    )
    attenuation_tolerance: float = Field(0.2, ge=0, le=2, description="Either way, dB/cm/MHz.")
    depth_mm: float = Field(40.0, gt=5, le=300, description="Depth of the images.")
    sampling_rate_mhz: float | None = Field(None, gt=0, le=1000, description="Of the RF.")
    vector_pitch_mm: float | None = Field(None, gt=0, le=5, description="Distance of vectors.")
    speed_of_sound_m_s: float = Field(SPEED_M_S, gt=300, le=4000)
    probe: str = Field("", description="Name of probe and preset as recordings have it.")

    @field_validator("band_mhz")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.1 < value[0] < value[1] < 100:
            raise ValueError("expected 0.1 < low < high < 100")
        return value

    @property
    def nominal(self) -> NominalProbe:
        """Probe and tissue that the elevational field is calculated for."""
        transmit = self.transmit_aperture_mm
        return NominalProbe(
            self.elevation_aperture_mm,
            self.elevation_focus_mm,
            self.elevation_focus_mm / self.f_number if transmit is None else transmit,
            1e6 * self.band_mhz[0],
            1e6 * self.band_mhz[1],
            self.attenuation_db_cm_mhz,
        )

    @property
    def signal(self) -> RFSettings:
        """How vectors are sampled, for curves that are made like no sweep.

        Raises
        ------
        InvalidInputError
            If the sheet does not say.
        """
        if self.sampling_rate_mhz is None:
            raise InvalidInputError(
                "sampling_rate_mhz: expected in the probe's settings, or a sweep, got none"
            )
        low, high = self.nominal.low_hz, self.nominal.high_hz
        return RFSettings(
            1e6 * self.sampling_rate_mhz, self.speed_of_sound_m_s, (low + high) / 2.0, (low, high)
        )


def sheet_curves(
    sheet: ProbeSheet,
    key: CurveKey,
    depth_mm: FloatArray,
    seen: EchoSpectra | None = None,
    speckle_mm2: FloatArray | None = None,
    largest_mm: float = 2.5,
) -> DecorrelationCurves:
    """Curves of a probe by diffraction, with the error that its tolerances leave.

    Parameters
    ----------
    key : CurveKey
        Signal and patches that the curves are for.
    depth_mm : ndarray, shape (r,)
    seen : EchoSpectra, optional
        Of a sweep; takes the place of band, attenuation and backscatter in the sheet.
    speckle_mm2 : ndarray, shape (r,), optional
        Area of one independent cell of speckle at each depth; by default from band and f-number.
    """
    rows, probe, speed = np.asarray(depth_mm, dtype=float), sheet.nominal, sheet.speed_of_sound_m_s
    grid: FloatArray = GRID_MM * np.arange(round(largest_mm / GRID_MM) + 1, dtype=float)
    band = key.signal.bandwidth_hz if isinstance(key.signal, RFSettings) else (probe.low_hz, probe.high_hz)
    frequency = band_nodes(band, key.edge_fraction)
    passed = _passed(frequency, band, key.edge_fraction)
    inside = key.patch_height_mm * ((np.arange(SUB_DEPTHS) + 0.5) / SUB_DEPTHS - 0.5)
    depths = np.maximum(rows[:, None] + inside, 1.0)

    if seen is not None:
        sent = seen.at(depths, frequency)
    else:
        exponents = sheet.attenuation_db_cm_mhz, sheet.backscatter_exponent
        sent = sheet_spectrum(frequency, (probe.low_hz, probe.high_hz), *exponents, depths)
    weight = sent * passed**2
    rho = speckle_correlation(probe, depths, frequency, weight, grid, speed)
    cells = (
        key.patch_width_mm
        * key.patch_height_mm
        / (speckle_mm2 if speckle_mm2 is not None else _speckle_area(sheet, frequency, weight.mean(axis=1)))
    )
    of_echo = key.correlation_of == "echo"
    raised = rho + ((1.0 - rho) ** 2 / cells[:, None] if of_echo else 0.0)
    correlation = np.minimum.accumulate(np.clip(raised, LEAST_AMPLITUDE, 1.0), axis=1)
    tilt = None
    if isinstance(key.signal, RFSettings):
        width = np.array([np.interp(0.5, -np.log(row), grid) for row in correlation])
        pivot = tilt_pivot(probe, rows, frequency, weight.mean(axis=1), speed)
        tilt = TiltResponse(pivot, two_way_wavenumber(key.signal) * width**2)
    return DecorrelationCurves(
        key,
        rows,
        grid,
        correlation,
        np.asarray(cells),
        tilt=tilt,
        scale_sigma=sheet_sigma(sheet, rows, seen is not None),
        origin="data sheet",
        nominal=probe,
    )


def sheet_sigma(sheet: ProbeSheet, depth_mm: FloatArray, spectrum_known: bool) -> float:
    """Relative standard deviation that the sheet's tolerances and the model leave in all distances.

    Tissue is within the attenuation's tolerance. With the echo's spectrum known, neither attenuation nor
    frequency matters any more.
    """
    probe = sheet.nominal

    def widths(side: float) -> FloatArray:
        """Mean logarithm of the curves' widths with one number at a time at the end of its tolerance."""
        pitch = 1.0 + side * sheet.frequency_tolerance
        attenuation = max(probe.attenuation_db_cm_mhz + side * sheet.attenuation_tolerance, 0.0)
        varied = [
            replace(probe, focus_mm=probe.focus_mm * (1.0 + side * sheet.focus_tolerance)),
            replace(probe, aperture_mm=probe.aperture_mm * (1.0 + side * sheet.aperture_tolerance)),
            replace(probe, attenuation_db_cm_mhz=attenuation),
            replace(probe, low_hz=pitch * probe.low_hz, high_hz=pitch * probe.high_hz),
        ]
        some = varied[:2] if spectrum_known else varied
        return np.array([log_width(one, depth_mm, sheet.backscatter_exponent).mean() for one in some])

    sigma = UNIFORM * (widths(1.0) - widths(-1.0)) / 2.0
    return float(np.sqrt((sigma**2).sum() + MODEL_SIGMA**2))


def _passed(frequency_hz: FloatArray, band_hz: tuple[float, float], edge_fraction: float) -> FloatArray:
    """Amplitude that the band-pass before matching lets through; see `speckle3d.matching.intensity`."""
    edge = edge_fraction * (band_hz[1] - band_hz[0])
    outside = np.maximum(band_hz[0] - frequency_hz, frequency_hz - band_hz[1]) / edge
    return np.asarray(np.where(outside < 1, np.cos(np.pi / 2 * np.clip(outside, 0, 1)) ** 2, 0.0))


def _speckle_area(sheet: ProbeSheet, frequency_hz: FloatArray, power: FloatArray) -> FloatArray:
    """Area of one independent cell of the echo, integral of its squared coherence, by depth, mm^2."""
    step = frequency_hz[1] - frequency_hz[0]
    total = power.sum(axis=1)
    axial = 0.5e3 * sheet.speed_of_sound_m_s * (power**2).sum(axis=1) / (total**2 * step)
    wavelength = 1e3 * sheet.speed_of_sound_m_s / ((power * frequency_hz).sum(axis=1) / total)
    return np.asarray(axial * LATERAL_CELL * wavelength * sheet.f_number)
