"""`OnlineFilter`: orientation while samples arrive, one by one or in pieces."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.text import shown
from xsens.fusion.engines import BLOCK_S, Filter
from xsens.fusion.readings import LOST, PAUSE_S, Samples, lost_variance
from xsens.logs.contradictions import FASTEST_RAD_S, not_in_metres
from xsens.logs.faults import LIMITS
from xsens.logs.samples import VECTORS, row_norms

_FOLLOWS = 0.05
"""How fast the usual step between samples follows theirs, as a fraction of a sample."""


@shown
@dataclass(frozen=True)
class OnlineState:
    """Estimate of the filter after the last sample.

    Attributes
    ----------
    world_from_sensor : Rotation, single
        x magnetic north, y west, z up. Without readings of the magnetometer x is where it was at the start.
    standard_deviation_rad : ndarray, shape (3,)
        About the world's axes: two of inclination, one of heading; at the end of the last whole increment.
    gyro_bias_rad_s : ndarray, shape (3,)
    disturbed : bool
        True while the magnetic field is not trusted.
    resting : bool
    started : bool
        True when the first second, which finds up and north, is over.
    field_stray, field_iron : float
        How much the field changes from place to place, and the likelihood of iron on the sensor, as in
        `Orientation`; NaN before the field was used.
    """

    world_from_sensor: Rotation
    standard_deviation_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    disturbed: bool
    resting: bool
    started: bool
    field_stray: float
    field_iron: float


class OnlineFilter:
    """The filter of `xsens.orient` for samples as they arrive.

    Samples are gathered to increments of 1/32 s; between two of them the gyroscope alone
    carries the orientation, so that `state` is always that of the last sample.

    Examples
    --------
    >>> from xsens import OnlineFilter
    >>> live = OnlineFilter()
    >>> for _ in range(200):
    ...     live.push(0.01, [0, 0, 0], [0, 0, 9.81], [0.4, 0, -0.9])
    >>> live.state.started, live.state.disturbed
    (True, False)
    """

    def __init__(self) -> None:
        self._filter = Filter()
        self._state: OnlineState | None = None
        self._pending: list[tuple[Any, ...]] = []  # since the filter ran: once in an increment is enough
        self._rate: FloatArray | None = None
        self._force = np.full(3, np.nan)
        self._skipped_s, self._forceless_s = 0.0, np.inf
        self._usual_s = np.nan

    def push(
        self,
        step_s: ArrayLike,
        gyroscope_rad_s: ArrayLike,
        accelerometer_m_s2: ArrayLike,
        magnetometer_au: ArrayLike | None = None,
    ) -> None:
        """Add samples.

        Parameters
        ----------
        step_s : float or array_like, shape (m,)
            Time from the sample before to each sample; more than 0.125 s is a pause, after which up and north
            are found again.
        gyroscope_rad_s, accelerometer_m_s2 : array_like, shape (3,) or (m, 3)
            A sample without gyroscope (NaN) is left out, one without accelerometer takes the last reading of
            0.125 s.
        magnetometer_au : array_like, shape (3,) or (m, 3), optional
            Rows may be NaN; rows of zeros count as missing too.

        Raises
        ------
        MismatchError
            If the shapes do not fit together.
        InvalidInputError
            If a step is not positive and finite, the gyroscope is not in rad/s or, by its mean at the start,
            the accelerometer is not in m/s^2.
        """
        steps, rates, forces, fields = _require_readings(
            step_s, gyroscope_rad_s, accelerometer_m_s2, magnetometer_au
        )
        for step_s, rate, force, field in zip(map(float, steps), rates, forces, fields, strict=True):
            self._skipped_s += step_s
            self._forceless_s += step_s
            if np.isfinite(force).all():
                self._force, self._forceless_s = force, 0.0
            if np.isfinite(rate).all() and self._forceless_s <= PAUSE_S:
                self._add(self._skipped_s, rate, field)
                self._skipped_s = 0.0
        if sum(step_s for step_s, *_ in self._pending) >= BLOCK_S:
            self._run()

    def _add(self, step_s: float, rate: FloatArray, field: FloatArray) -> None:
        """Add a sample, so long after the last one, with the last force."""
        lost_rad2 = 0.0
        if self._rate is None:
            self._usual_s = min(step_s, PAUSE_S)
        else:
            steps, rates = np.array([0.0, step_s]), np.array([self._rate, rate])
            lost_rad2 = float(lost_variance(steps, rates, self._usual_s)[0])
        self._usual_s += _FOLLOWS * (min(step_s, LOST * self._usual_s) - self._usual_s)
        if step_s > PAUSE_S:
            self._run()
            # The turn in a pause is not known, nor is the first sample's own step.
            self._filter.begin(step_s)
            step_s = BLOCK_S
        self._rate = rate
        self._pending.append((step_s, rate, self._force, field, lost_rad2))

    def _run(self) -> None:
        """Filter what is pending."""
        if not self._pending:
            return
        estimate = self._filter.run(Samples(*map(np.array, zip(*self._pending, strict=True))))
        self._pending = []
        if len(last := self._filter.last):
            if last["started"][0] and (problem := not_in_metres(self._filter.start_force_m_s2)):
                raise InvalidInputError(f"accelerometer_m_s2: {problem}")
            last_row = {name: v[-1] if v.ndim > 1 else v[-1].item() for name, v in vars(estimate).items()}
            turn = Rotation.from_quat(last_row.pop("xyzw"))
            self._state = OnlineState(turn, started=bool(last["started"][0]), **last_row)

    @property
    def state(self) -> OnlineState | None:
        """Estimate after the last sample; None before the first whole increment."""
        self._run()
        return self._state


def _require_readings(step_s: ArrayLike, *vectors: ArrayLike | None) -> list[FloatArray]:
    """Steps and readings; what is no measurement, zeros or out of range, is NaN."""
    step = np.array(step_s, dtype=float, ndmin=1)
    if not (np.isfinite(step) & (step > 0.0)).all():
        raise InvalidInputError("step_s: expected positive numbers, got one that is not")
    shape = (step.size, 3)
    readings = [np.full(shape, np.nan) if v is None else np.array(v, dtype=float, ndmin=2) for v in vectors]
    if any(rows.shape != shape for rows in readings):
        raise MismatchError(f"expected readings of shape {shape}, got {[rows.shape for rows in readings]}")
    rate, force, field = readings
    if (fast := np.nanmax(row_norms(rate), initial=0.0)) > FASTEST_RAD_S:
        raise InvalidInputError(f"gyroscope_rad_s: expected rad/s, got a reading of {fast:.3g}: in deg/s?")
    size = row_norms(force)
    force[~((size > 0.0) & (size < LIMITS[VECTORS[0]].largest))] = np.nan
    field[~field.any(axis=1)] = np.nan
    rate[~rate.any(axis=1) & np.isnan(force[:, 0])] = np.nan
    return [step, *readings]
