"""Decorrelation curves calculated from a probe's data sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import DecorrelationCurves, NominalProbe, TiltResponse, curve_widths
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.matching.intensity import band_weights, two_way_wavenumber
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.texture import measured_texture
from speckle3d.motion.diffraction import (
    BACKSCATTER_EXPONENT,
    SPEED_M_S,
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
PULSE_EDGES = 1.0
"""Width of what a pulse has on either side of the band that sheets state, -6 dB, over the band's."""
GRID_MM = 0.01
LEAST_AMPLITUDE = 1e-4


class ProbeSheet(BaseModel):
    """Data sheet of a probe and settings of the scanner (``probe.toml``)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    elevation_aperture_mm: float = Field(gt=0.5, le=40, description="Height of the elements.")
    elevation_focus_mm: float = Field(gt=2, le=300, description="Depth at which the lens focuses.")
    band_mhz: tuple[float, float] = Field(
        description="Where the pulse-echo spectrum of a reflector on the axis is at -6 dB, low and high."
    )
    attenuation_db_cm_mhz: float = Field(0.5, ge=0, le=3, description="Of the tissue, one way.")
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
    speed_of_sound_m_s: float = Field(SPEED_M_S, gt=300, le=4000)

    @field_validator("elevation_focus_mm")
    @classmethod
    def _check_focus(cls, value: float, info: ValidationInfo) -> float:
        height = info.data.get("elevation_aperture_mm", 0.0)
        if value < height:
            raise ValueError(f"expected a focus below the aperture's {height:g} mm: are the two exchanged?")
        return value

    @field_validator("band_mhz")
    @classmethod
    def _check_band(cls, value: tuple[float, float]) -> tuple[float, float]:
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


def data_sheet_curves(sheet: ProbeSheet, like: Sweep, config: Config | None = None) -> DecorrelationCurves:
    """Calculate decorrelation curves of a probe by diffraction.

    Parameters
    ----------
    sheet : ProbeSheet
        What the data sheet says.
    like : Sweep
        A sweep of the probe, whose signal, depths and patches the curves are made for. Of RF its spectrum by
        depth takes the place of the sheet's frequencies and attenuation, and its speckle tells the patches'
        cells.
    config : Config, optional
    """
    settings, probe, speed = config or Config(), sheet.nominal, sheet.speed_of_sound_m_s
    matcher = FrameMatcher(like, settings)
    key, rows, texture = matcher.key, matcher.patches.row_depth_mm, measured_texture(like, matcher)
    size, spectra = texture.speckle_size(), texture.spectra()
    area = 2.0 * np.pi * _interpolate(rows, size.lateral_mm) * _interpolate(rows, size.axial_mm)
    # Of grey levels no filter takes away what the pulse has beyond -6 dB.
    band, edge_fraction = (probe.low_hz, probe.high_hz), PULSE_EDGES
    if isinstance(key.signal, RFSettings):
        band, edge_fraction = key.signal.bandwidth_hz, key.edge_fraction
    frequency = band_nodes(band, edge_fraction)
    if spectra is None:
        exponents = sheet.attenuation_db_cm_mhz, BACKSCATTER_EXPONENT
        spectrum = sheet_spectrum(frequency, (probe.low_hz, probe.high_hz), *exponents, rows)
    else:
        spectrum = spectra.at(rows, frequency)
    weight = spectrum * band_weights(frequency, *band, edge_fraction * (band[1] - band[0])) ** 2
    area = area if np.isfinite(area).all() else _speckle_area(sheet, frequency, weight)
    cells = key.patch_width_mm * key.patch_height_mm / area
    grid = GRID_MM * np.arange(round(settings.curves.largest_mm / GRID_MM) + 1, dtype=float)
    rho = speckle_correlation(probe, rows, frequency, weight, grid, speed, spectra is None)
    if key.correlation_of == "echo":
        rho += (1.0 - rho) ** 2 / cells[:, None]
    rho, tilt = np.minimum.accumulate(np.clip(rho, LEAST_AMPLITUDE, 1.0), axis=1), None
    if isinstance(key.signal, RFSettings):
        pivot = tilt_pivot(probe, rows, frequency, weight, speed)
        tilt = TiltResponse(pivot, two_way_wavenumber(key.signal) * curve_widths(grid, rho) ** 2)
    sigma = sheet_sigma(sheet, rows, spectra is not None)
    return DecorrelationCurves(
        key, rows, grid, rho, cells, tilt=tilt, scale_sigma=sigma, origin="data sheet", nominal=probe
    )


def _interpolate(depth_mm: FloatArray, values: FloatArray) -> FloatArray:
    """Values by depth, those not known from their neighbours; all NaN if none is known."""
    finite = np.isfinite(values)
    return np.interp(depth_mm, depth_mm[finite], values[finite]) if finite.any() else values


def sheet_sigma(sheet: ProbeSheet, depth_mm: FloatArray, has_spectrum: bool) -> float:
    """Relative standard deviation of all distances by the sheet's tolerances and the model.

    Tissue is within the attenuation's tolerance. With the echo's spectrum known, neither attenuation nor
    frequency matters any more.
    """
    probe = sheet.nominal

    def widths(side: float) -> FloatArray:
        """Mean logarithm of the curves' widths with one number at a time at the end of its tolerance."""
        pitch = 1.0 + side * sheet.frequency_tolerance
        attenuation = max(probe.attenuation_db_cm_mhz + side * sheet.attenuation_tolerance, 0.0)
        variants = [
            replace(probe, focus_mm=probe.focus_mm * (1.0 + side * sheet.focus_tolerance)),
            replace(probe, aperture_mm=probe.aperture_mm * (1.0 + side * sheet.aperture_tolerance)),
            replace(probe, attenuation_db_cm_mhz=attenuation),
            replace(probe, low_hz=pitch * probe.low_hz, high_hz=pitch * probe.high_hz),
        ]
        variants = variants[:2] if has_spectrum else variants
        return np.array([log_width(v, depth_mm).mean() for v in variants])

    sigma = UNIFORM * (widths(1.0) - widths(-1.0)) / 2.0
    return float(np.sqrt((sigma**2).sum() + MODEL_SIGMA**2))


def _speckle_area(sheet: ProbeSheet, frequency_hz: FloatArray, power: FloatArray) -> FloatArray:
    """Area of one independent cell of the echo, integral of its squared coherence, by depth, mm^2."""
    step = frequency_hz[1] - frequency_hz[0]
    total = power.sum(axis=1)
    axial = 0.5e3 * sheet.speed_of_sound_m_s * (power**2).sum(axis=1) / (total**2 * step)
    wavelength = 1e3 * sheet.speed_of_sound_m_s / ((power * frequency_hz).sum(axis=1) / total)
    return np.asarray(axial * LATERAL_CELL * wavelength * sheet.f_number)
