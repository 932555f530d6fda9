"""VQF (Laidig and Seel, Information Fusion 91, 2023) as an engine beside the filter of this package.

VQF wants an even clock, a field at every sample, and gives no standard deviation of the orientation. Here its
samples are brought to an even clock where the log's is not, missing fields are carried by the orientation of
this package's own engine, and what that engine claims, and how far VQF is from it, become VQF's deviation.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.fusion.readings import Estimate, Samples
from xsens.logs.worlds import nwu_from

_EVEN = 0.05
"""Largest distance of a sample from its place on an even clock, in steps, that is left as it is: at 5 rad/s
and 100 samples/s it is 0.15 degrees, and does not add up."""

_COMPARED_S = 1.0 / 32.0
"""How often VQF is compared with the other engine: as often as that one corrects itself."""

_AVERAGED_S = 5.0
"""Time over which their squared distance is averaged, so that it is not zero where the two cross."""


class VqfEngine:
    """VQF over the stretches of a log, each by itself.

    Parameters
    ----------
    magnetic : bool
        Let the magnetic field tell the heading.

    Raises
    ------
    InvalidInputError
        If VQF is not installed.
    """

    def __init__(self, magnetic: bool) -> None:
        try:
            import vqf
        except ImportError as error:
            raise InvalidInputError(
                "the methods vqf and vqf-online need the package vqf, got none installed: pip install vqf, "
                "which may need a C++ compiler, or choose smoother or filter"
            ) from error
        self._vqf = vqf
        self._magnetic = magnetic
        self._uneven = 0
        self._fields: list[bool] = []

    @property
    def notes(self) -> list[str]:
        """What VQF made of the log, for those who see the orientation."""
        notes = []
        if self._uneven:
            notes.append(
                f"VQF wants an even clock: {self._uneven} samples between pauses interpolated to one"
            )
        if self._fields and not any(self._fields):
            notes.append(
                "VQF came to know no magnetic field, for which it wants 5 s of turning by over 20 deg/s: it "
                "takes all of it for disturbed"
            )
        return notes

    def run(self, stretch: Samples, own: Estimate, offline: bool) -> Estimate:
        """Find the orientation of a stretch.

        Parameters
        ----------
        stretch : Samples
        own : Estimate
            The same by this package's engine: its variances, plus the squared distance of VQF from it about
            each of the world's axes, averaged over some seconds, are VQF's variances.
        offline : bool
            Use later readings as well.
        """
        magnetic = self._magnetic and bool(np.isfinite(stretch.field_au[:, 0]).any())
        readings = [stretch.rate_rad_s, stretch.force_m_s2]
        if magnetic:
            readings.append(_field_carried(stretch, own.xyzw))
        place = np.cumsum(stretch.step_s) - stretch.step_s[0]
        step_s = float(place[-1]) / (len(place) - 1) if len(place) > 1 else float(stretch.step_s[0])
        place, at = place / step_s, slice(None)
        uneven = float(np.abs(place - np.arange(len(place))).max()) >= _EVEN
        if uneven:
            self._uneven += len(stretch)
            # Losses make the mean step longer than the median, bursts shorter: at most two for one.
            fewer = min(max(float(np.median(stretch.step_s)) / step_s, 0.5), 1.0)
            place, step_s = place / fewer, step_s * fewer
            readings = _on_even_clock(readings, place)
        find = self._vqf.offlineVQF if offline else self._vqf.VQF(step_s).updateBatch
        found = find(*readings, *([] if magnetic else [None]), *([step_s] if offline else []))
        turns = Rotation.from_quat(found["quat9D" if magnetic else "quat6D"], scalar_first=True)
        north = nwu_from("ENU")
        if not magnetic:  # about up as the other engine begins
            about_up = np.arctan2(*(Rotation.from_quat(own.xyzw[0]) * turns[0].inv()).as_quat()[2:])
            north = Rotation.from_rotvec([0.0, 0.0, 2.0 * about_up])
        turns = north * turns
        if uneven:
            turns = Slerp(np.arange(len(turns)), turns)(np.minimum(place, len(turns) - 1))
            at = np.minimum(np.rint(place).astype(np.int64), len(found["bias"]) - 1)
        disturbed = np.zeros(len(stretch), dtype=bool)
        if magnetic:
            disturbed = found["magDistDetected"][at]
            self._fields.append(not disturbed.all())
        xyzw = turns.as_quat()
        apart = _apart_variance(xyzw, own.xyzw, float(np.mean(stretch.step_s)))
        sd = np.minimum(np.sqrt(own.sd_rad**2 + apart), np.pi)
        resting = found["restDetected"][at]
        return Estimate(xyzw, sd, found["bias"][at], disturbed, resting, own.field_stray, own.field_iron)


def _field_carried(stretch: Samples, xyzw: FloatArray) -> FloatArray:
    """The field, each hole filled with the reading before it, or the first, which stays in the world."""
    there = np.asarray(np.isfinite(stretch.field_au).all(axis=1))
    if there.all():
        return stretch.field_au
    last = np.maximum.accumulate(np.where(there, np.arange(len(there)), np.argmax(there)))
    turns = Rotation.from_quat(xyzw)
    return np.asarray(turns.inv().apply(turns[last].apply(stretch.field_au[last])))


def _on_even_clock(readings: list[FloatArray], place: FloatArray) -> list[FloatArray]:
    """Rate, force and perhaps field that lie at places on an even clock, in its steps, brought to it.

    A gyroscope's reading is the mean rate since the sample before; on the new clock, too, so that the turn
    from end to end stays what it was. Accelerometer and field are interpolated.
    """
    grid = np.arange(round(float(place[-1])) + 1.0)

    def at_grid(values: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(grid, place, axis) for axis in values.T])

    rate, *others = readings
    angle = np.cumsum(np.vstack([np.zeros(3), rate[1:] * np.diff(place)[:, None]]), axis=0)
    return [np.vstack([rate[:1], np.diff(at_grid(angle), axis=0)]), *map(at_grid, others)]


def _apart_variance(xyzw: FloatArray, other: FloatArray, step_s: float) -> FloatArray:
    """Squared distance of two orientations about the world's axes, shape (m, 3): past mean or now."""
    stride = max(1, round(_COMPARED_S / step_s))
    one, two = (Rotation.from_quat(each[::stride]) for each in (xyzw, other))
    square = (one * two.inv()).as_rotvec() ** 2
    keep = math.exp(-stride * step_s / _AVERAGED_S)
    mean, _ = lfilter([1.0 - keep], [1.0, -keep], square, axis=0, zi=keep * square[:1])
    return np.repeat(np.maximum(mean, square), stride, axis=0)[: len(xyzw)]
