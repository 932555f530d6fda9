"""Whether the magnetometer can be trusted where a sensor was used, by what its fusion found of the field."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion.orient import Orientation, orient
from xsens.fusion.settings import FusionSettings
from xsens.logs.samples import ImuLog

if TYPE_CHECKING:
    from xsens.fusion.online import OnlineState  # which loads numba

HELD_RAD, LOST_RAD = math.radians(3.0), math.radians(10.0)
"""A heading's standard deviation up to which it is held, as the sensors' makers state it for movement, and
beyond which a reconstruction is better off without."""

_WORST = 95.0
"""Percentile of the heading's standard deviation that counts: the first second is the worst."""

_SOME, _MOST = 0.1, 0.5
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
    """What a fusion found of the magnetic field.

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
        trust = self.trust
        if trust is Trust.UNKNOWN:
            return f"The magnetometer {trust} here: it has told nothing of the heading yet."
        parts = [
            f"The magnetometer {trust} here: with it the heading is known to {_deg(self.heading_sd_rad)}"
        ]
        if math.isfinite(self.drift_rad):
            alone = f"the gyroscope alone drifts by {_deg(self.drift_rad)} in {self.duration_s:.0f} s"
            parts.append(f"; {alone} (one standard deviation each)")
        else:
            parts.append(" (one standard deviation)")
        even = f"the field changes by {100.0 * self.stray:.1f}\N{NO-BREAK SPACE}% from place to place"
        parts.append(f". {_capital(even)}, and {_share(self.disbelieved)} of its readings are disbelieved.")
        doubts = self._doubts()
        if doubts:
            parts.append(f" {_capital('; '.join(doubts))}.")
        return "".join(parts) + self._advice(trust)

    def _doubts(self) -> list[str]:
        doubts = []
        if self.iron > 0.5:
            doubts.append("part of it turns with the sensor, as by iron on the probe, and is taken off")
        if self.stray > ROUGH:
            doubts.append("such a field is rough: iron or motors are near")
        if self.disbelieved > _SOME:
            doubts.append("something magnetic comes near at times")
        if self.heading_sd_rad > HELD_RAD:
            doubts.append(f"a good field holds the heading to {_deg(HELD_RAD)}")
        return doubts

    def _advice(self, trust: Trust) -> str:
        if self.drift_rad < self.heading_sd_rad:
            return " Within this recording the gyroscope alone does better (--no-magnetometer)."
        if trust is Trust.NO:
            return " Move away from iron and motors, or leave it out (--no-magnetometer)."
        return ""


def _deg(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.1f}\N{DEGREE SIGN}"


def _share(share: float) -> str:
    return "none" if share == 0.0 else f"{100.0 * share:.1f}\N{NO-BREAK SPACE}%"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def field_of(log: ImuLog, found: Orientation) -> FieldFound:
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
    if not found.magnetic or not np.isfinite(found.field_stray).any():
        return FieldFound(math.pi, 0.0, math.nan, math.nan, duration_s=log.duration_s)
    alone = orient(log, FusionSettings(use_magnetometer=False))
    heading = found.standard_deviation_rad[:, 2]
    return FieldFound(
        heading_sd_rad=float(np.percentile(heading, _WORST)),
        disbelieved=float(found.disturbed.mean()),
        stray=float(np.nanmedian(found.field_stray)),
        iron=float(np.nanmedian(found.field_iron)),
        drift_rad=float(alone.standard_deviation_rad[-1, 2]),
        duration_s=log.duration_s,
    )


def field_now(state: OnlineState, disbelieved: float) -> FieldFound:
    """What a filter finds of the field while samples arrive, with the share it disbelieved lately."""
    sd_rad = float(state.standard_deviation_rad[2])
    found = FieldFound(sd_rad, disbelieved, state.field_stray, state.field_iron)
    return found if state.started else replace(found, stray=math.nan)


def dip_rad(field_in_world: FloatArray) -> FloatArray:
    """Angle of fields in the world, shape (m, 3), below the horizontal."""
    across = np.hypot(field_in_world[:, 0], field_in_world[:, 1])
    return np.asarray(np.arctan2(-field_in_world[:, 2], across))
