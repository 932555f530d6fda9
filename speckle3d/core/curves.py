"""Decorrelation curves, and the signal and patches they were measured with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.core.text import shown

Origin = Literal["phantom", "tracked", "data sheet", "crossing"]
"""What curves' distances come from: exact steps, a tracker, diffraction, or a sweep that crosses another."""
ATTENUATION_SIGMA = 0.03
"""Relative standard deviation of all distances from tissue that attenuates otherwise than what the curves
were measured in: soft tissues lie within 0.3 dB/cm/MHz of a phantom, taken as uniform (a deviation of 0.17),
and 0.1 dB/cm/MHz widens the beam by 1.6 to 2 % by diffraction."""
PROBE_SIGMA = 0.08
"""The same from a probe that is not the one the curves were measured on, attenuation included. Lenses of one
model focus within 10 %, apertures are as high within 5 %, either way: 8 to 13 and 5 % of length at those
bounds on simulated sweeps, taken as evenly spread between them (over the root of 3)."""

BAND_ADVICE = (
    " (where a recording does not say its band, it is measured, and never twice the same: give bandwidth_hz)"
)


@dataclass(frozen=True)
class CurveKey:
    """Signal and patches that curves were measured with; a sweep with another key needs other curves.

    Attributes
    ----------
    edge_fraction : float
        Width of the band's edges over its width; the default is what all versions wrote before files gave it.
    probe : str
        Name of probe and preset as the recording has it; empty if it has none, and then not compared.
    lines : {"parallel", "fan", ""}
        How vectors lie; empty if nothing says, and then not compared.
    array_radius_mm, line_step_rad : float
        Of a fan's array (0: phased), and the angle between its vectors. Of fans these are compared in place
        of the pitch, which grows with the depth that is recorded.
    """

    signal: RFSettings | BModeSettings
    vector_pitch_mm: float
    patch_width_mm: float
    patch_height_mm: float
    equalise_mm: float
    correlation_of: str = "intensity"
    edge_fraction: float = 0.1
    probe: str = ""
    lines: str = ""
    array_radius_mm: float = 0.0
    line_step_rad: float = 0.0

    def require_same(self, other: CurveKey, own: str = "the curves") -> None:
        """Raise `MismatchError` naming the first setting in which `other` (a sweep's key) differs."""
        others = _settings(other)
        for name, value in _settings(self).items():
            theirs = others.get(name, value)
            if theirs != value if isinstance(value, str) else not np.allclose(value, theirs, 1e-3, 1e-9):
                advice = BAND_ADVICE if name == "bandwidth_hz" else ""
                raise MismatchError(
                    f"{own} do not match the sweep: {name} of {own} is {value!r}, "
                    f"of the sweep {theirs!r}{advice}"
                )


@dataclass(frozen=True)
class TiltResponse:
    """Effect of tilt, by depth, on the correlation.

    Speckle that is tilted by theta while its patch moves by z decorrelates as if it had moved by d, with
    d^2 = (z - pivot theta)^2 + (spread theta)^2: a curved wavefront is moved least by turning about its
    centre of curvature, and turning about that spreads the echo's phase over the beam.

    Attributes
    ----------
    pivot_mm, spread_mm : ndarray, shape (r,)
    """

    pivot_mm: FloatArray
    spread_mm: FloatArray


@dataclass(frozen=True)
class SpeckleSize:
    """Width of speckle in the image, by depth, as a probe and its settings make it.

    Attributes
    ----------
    lateral_mm, axial_mm : ndarray, shape (r,)
        Standard deviation of the Gaussian that intensity's correlation between neighbouring samples fits.
    """

    lateral_mm: FloatArray
    axial_mm: FloatArray


@dataclass(frozen=True)
class EchoSpectra:
    """Power spectrum of echoes by depth; attenuation and the pulse's true frequency are in it.

    Attributes
    ----------
    depth_mm : ndarray, shape (y,)
        Increasing.
    frequency_hz : ndarray, shape (f,)
        Increasing.
    power : ndarray, shape (y, f)
        In any unit, which may differ from depth to depth.
    """

    depth_mm: FloatArray
    frequency_hz: FloatArray
    power: FloatArray

    def __post_init__(self) -> None:
        shape = self.depth_mm.size, self.frequency_hz.size
        if self.power.shape != shape or not (self.power >= 0).all():
            raise InvalidInputError(f"spectrum, power: expected values of zero or above, shape {shape}")

    def at(self, depth_mm: FloatArray, frequency_hz: FloatArray) -> FloatArray:
        """Power at depths of any shape and at other frequencies, shape (..., f)."""
        columns = np.stack([np.interp(frequency_hz, self.frequency_hz, row) for row in self.power])
        return np.stack([np.interp(depth_mm, self.depth_mm, column) for column in columns.T], axis=-1)


@dataclass(frozen=True)
class NominalProbe:
    """Probe and tissue that curves were calculated for.

    Attributes
    ----------
    aperture_mm, focus_mm : float
        Height of the elements, and where the lens focuses.
    transmit_mm : float
        Width of the transmit aperture.
    low_hz, high_hz : float
        Band of the pulse, at -6 dB.
    attenuation_db_cm_mhz : float
    """

    aperture_mm: float
    focus_mm: float
    transmit_mm: float
    low_hz: float
    high_hz: float
    attenuation_db_cm_mhz: float


@shown
@dataclass(frozen=True)
class DecorrelationCurves:
    """Correlation of fully developed speckle against elevational distance, by depth.

    Attributes
    ----------
    depth_mm : ndarray, shape (r,)
        Increasing.
    distance_mm : ndarray, shape (k,)
        Equal steps from zero.
    correlation : ndarray, shape (r, k)
        Decreasing along k.
    cells : ndarray, shape (r,)
        Independent speckle cells in a patch; see `speckle3d.kernels.statistics`.
    tilt : TiltResponse or None
        None if the phantom sweeps did not turn.
    speckle : SpeckleSize or None
        Of the phantom's images; None in files that older versions wrote.
    scale_sigma : float
        Relative standard deviation of the factor that is common to all distances on a sweep that the curves
        are used for, by their origin; see `PROBE_SIGMA`.
    origin : {"phantom", "tracked", "data sheet", "crossing"}
    nominal : NominalProbe or None
        Of curves from a data sheet.
    spectrum : EchoSpectra or None
        Of the phantom's echoes, by which `speckle3d.motion.attenuation` tells tissue that attenuates
        otherwise; None for B-mode, other origins and files that older versions wrote.
    of_tissue : bool
        Whether the structure of what is scanned is in them, and is not to be adapted to: curves corrected
        by a tracker over what is no phantom, of images without phase.
    key : CurveKey
        Signal, vector pitch and patches that the curves are for.
    pairs_used : int
        Frame pairs that were measured.
    """

    key: CurveKey
    depth_mm: FloatArray
    distance_mm: FloatArray
    correlation: FloatArray
    cells: FloatArray
    pairs_used: int = 0
    tilt: TiltResponse | None = None
    speckle: SpeckleSize | None = None
    scale_sigma: float = PROBE_SIGMA
    origin: Origin = "phantom"
    nominal: NominalProbe | None = None
    spectrum: EchoSpectra | None = None
    of_tissue: bool = False

    def __post_init__(self) -> None:
        rho, shape = self.correlation, (self.depth_mm.size, self.distance_mm.size)
        longest_mm = self.distance_mm.max(initial=0.0)
        even = np.linspace(0.0, longest_mm, shape[1])
        parts = [vars(part) for part in (self.speckle, self.tilt) if part is not None]
        by_depth = [self.cells, *(values for part in parts for values in part.values())]
        requirements = {
            "distance_mm: expected equal steps from zero": longest_mm > 0
            and np.allclose(self.distance_mm, even),
            "correlation: expected values in (0, 1] that fall with distance": rho.shape == shape
            and (rho > 0).all()
            and (np.diff(rho, axis=1, prepend=1.0) <= 0).all(),
            "cells, speckle, tilt: expected a number for each depth, of cells above zero": all(
                values.shape == shape[:1] and np.isfinite(values).all() for values in by_depth
            )
            and (self.cells > 0).all(),
        }
        for expected, holds in requirements.items():
            if not holds:
                raise InvalidInputError(f"{expected}, got others")

    def at(self, depth_mm: FloatArray) -> DecorrelationCurves:
        """Curves at other depths, shape (p,), by linear interpolation of sqrt(-ln rho)."""

        def interpolate(values: FloatArray) -> FloatArray:
            return np.interp(depth_mm, self.depth_mm, values)

        def at_depths(fields: Any) -> Any:
            return fields and type(fields)(*map(interpolate, vars(fields).values()))

        roots = np.sqrt(-np.log(self.correlation))
        return replace(
            self,
            depth_mm=np.asarray(depth_mm),
            correlation=np.exp(-(np.array([*map(interpolate, roots.T)]).T ** 2)),
            cells=interpolate(self.cells),
            tilt=at_depths(self.tilt),
            speckle=at_depths(self.speckle),
        )

    def mismatch(self, same_probe: bool, attenuation_sigma: float = ATTENUATION_SIGMA) -> float:
        """Relative standard deviation of what the curves' mismatch does to all distances of a sweep.

        Parameters
        ----------
        same_probe : bool
            Whether a phantom's curves were measured with the very probe of the sweep.
        attenuation_sigma : float
            What tissue that attenuates otherwise than the phantom leaves of it.
        """
        if self.origin != "phantom":
            return self.scale_sigma
        lens = 0.0 if same_probe else self.scale_sigma**2 - ATTENUATION_SIGMA**2
        return float(np.sqrt(max(lens, 0.0) + attenuation_sigma**2))


def curve_widths(distance_mm: FloatArray, correlation: FloatArray) -> FloatArray:
    """Distance at which each curve, shape (r, k), has fallen to exp(-1/2), shape (r,), mm."""
    return np.array([np.interp(0.5, -np.log(row), distance_mm) for row in correlation])


def _settings(key: CurveKey) -> dict[str, Any]:
    """Settings that are told of the signal and the patches, by name."""
    is_rf = isinstance(key.signal, RFSettings)
    settings = {"signal": "", "lines": ""} | vars(key) | vars(key.signal)
    # How finely the echo was sampled, real or as I/Q, is no property of the beam, and matching resamples it.
    left_out = ["demodulation_frequency_hz", "dynamic_range_sigma_db", "sampling_rate_hz" * is_rf]
    left_out += ["vector_pitch_mm"] if key.lines == "fan" else ["array_radius_mm", "line_step_rad"]
    left_out += ["dynamic_range_db"] * (settings.get("dynamic_range_sigma_db", 0.0) > 0)
    settings["signal"] = "RF" if is_rf else "B-mode"
    return {name: value for name, value in settings.items() if name not in left_out and value != ""}
