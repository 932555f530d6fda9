"""Judge whether the magnetometer can be trusted, by the field found in the fusion."""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion.orient import Orientation, orient
from xsens.logs.samples import ImuLog, row_norms

HELD_RAD, LOST_RAD = math.radians(3.0), math.radians(10.0)
"""A heading's standard deviation up to which it is held, as the sensors' makers state it for movement, and
beyond which a reconstruction is better off without."""

_WORST = 95.0
"""Percentile of the heading's standard deviation that counts: the first second is the worst."""

_LEAST_SHARE, _MOST = 0.1, 0.5
"""Shares of readings that may be disbelieved: iron passed by, and a field that tells nothing."""

ROUGH = 0.03
"""A field that strays by more, as a fraction of its norm, is rough: where it dips by 65 degrees it turns a
reading's north by four. The fusion grows used to such a field, and takes it for what it is worth."""

POOR = 0.06
"""Twice as much: nine degrees, which is no north."""


class Trust(StrEnum):
    """How far a magnetometer's heading can be trusted."""

    YES = "can be trusted"
    CARE = "can be trusted with care"
    NO = "cannot be trusted"
    UNKNOWN = "cannot be judged"


@dataclass(frozen=True)
class FieldFound:
    """Properties of the magnetic field estimated by a fusion.

    Attributes
    ----------
    heading_sd_rad : float
        Standard deviation of the heading with the magnetometer.
    disbelieved : float
        Share of readings that were hardly believed.
    stray : float
        Change of the field from place to place, a fraction of its norm, per component.
    iron : float
        Likelihood that iron is on the sensor.
    drift_rad : float
        Standard deviation of the heading at the end, relative to the start, without the magnetometer; NaN if
        not known.
    duration_s : float
    """

    heading_sd_rad: float
    disbelieved: float
    stray: float
    iron: float
    drift_rad: float = math.nan
    duration_s: float = math.nan

    @property
    def trust(self) -> Trust:
        """How far the heading can be trusted."""
        if not math.isfinite(self.stray):
            return Trust.UNKNOWN
        if self.heading_sd_rad > LOST_RAD or self.disbelieved > _MOST or self.stray > POOR:
            return Trust.NO
        return Trust.CARE if self._doubts() else Trust.YES

    def sentence(self) -> str:
        """Whether the magnetometer can be trusted, why, and what to do if it cannot."""
        if self.trust is Trust.UNKNOWN:
            return f"The magnetometer {self.trust} here: it has told nothing of the heading yet."
        sd_deg, drift = math.degrees(self.heading_sd_rad), math.degrees(self.drift_rad)
        alone = ""
        if math.isfinite(drift):
            alone = f"; the gyroscope alone drifts by {drift:.1f}\N{DEGREE SIGN} in {self.duration_s:.0f} s"
        advice = ""
        if drift < sd_deg:
            advice = " Within this recording the gyroscope alone does better (--no-magnetometer)."
        elif self.trust is Trust.NO:
            advice = " Move away from iron and motors, or leave it out (--no-magnetometer)."
        return (
            f"The magnetometer {self.trust} here: with it the heading is known to {sd_deg:.1f}\N{DEGREE SIGN}"
            f"{alone} (standard deviation). The field changes by {100.0 * self.stray:.1f} % from place to "
            f"place, and {100.0 * self.disbelieved:.1f} % of its readings are disbelieved."
            + "".join(f" {words}." for words in self._doubts())
            + advice
        )

    def _doubts(self) -> list[str]:
        doubts = {
            "Part of it turns with the sensor, as by iron on the probe, and is taken off": self.iron > 0.5,
            "Such a field is rough: iron or motors are near": self.stray > ROUGH,
            "Something magnetic comes near at times": self.disbelieved > _LEAST_SHARE,
            f"A good field holds the heading to {math.degrees(HELD_RAD):.1f}\N{DEGREE SIGN}": (
                self.heading_sd_rad > HELD_RAD
            ),
        }
        return [words for words, so in doubts.items() if so]


def field_of(log: ImuLog, orientation: Orientation) -> FieldFound:
    """What the orientation of a log tells of the magnetic field.

    Parameters
    ----------
    log : ImuLog
    found : Orientation
        Of the log, with the magnetometer.

    Raises
    ------
    InsufficientDataError
        As `orient` does.
    """
    if not orientation.magnetic or not np.isfinite(orientation.field_stray).any():
        return FieldFound(math.pi, 0.0, math.nan, math.nan, duration_s=log.duration_s)
    alone = orient(log, magnetometer=False)
    heading = orientation.standard_deviation_rad[:, 2]
    return FieldFound(
        heading_sd_rad=float(np.percentile(heading, _WORST)),
        disbelieved=float(orientation.disturbed.mean()),
        stray=float(np.nanmedian(orientation.field_stray)),
        iron=float(np.nanmedian(orientation.field_iron)),
        drift_rad=float(alone.standard_deviation_rad[-1, 2]),
        duration_s=log.duration_s,
    )


def dip_rad(field_in_world: FloatArray) -> FloatArray:
    """Angle of fields in the world, shape (m, 3), below the horizontal."""
    return np.arctan2(-field_in_world[:, 2], row_norms(field_in_world[:, :2]))
