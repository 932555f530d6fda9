"""VQF (Laidig and Seel, Information Fusion 91, 2023) as an engine beside the filter of this package.

VQF wants an even clock, a field at every sample, and gives no standard deviation of the orientation. Here its
samples are brought to an even clock where the log's is not, missing fields are carried by the orientation of
this package's own engine, and what that engine claims, and how far VQF is from it, become VQF's deviation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.fusion.samples import Estimate, Samples
from xsens.logs.worlds import nwu_from, turned

_EVEN = 0.05
"""Largest distance of a sample from its place on an even clock, in steps, that is left as it is: at 5 rad/s
and 100 samples/s it is 0.15 degrees, and does not add up."""

_COMPARED_S = 1.0 / 32.0
"""How often VQF is compared with the other engine: as often as that one corrects itself."""

_AVERAGED_S = 5.0
"""Time over which their squared distance is averaged, so that it is not zero where the two cross."""


class _Even(NamedTuple):
    """Rate, force and field on an even clock; if it is another, where the samples lie on it, in steps."""

    vectors: list[FloatArray]
    step_s: float
    place: FloatArray | None


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
        field = [_field_carried(stretch, own.xyzw)] if magnetic else []
        (rate, force, *fields), step_s, place = _even_clock(
            [stretch.rate_rad_s, stretch.force_m_s2, *field], stretch.step_s
        )
        readings = (rate, force, fields[0] if fields else None)
        if offline:
            found = self._vqf.offlineVQF(*readings, step_s)
        else:
            found = self._vqf.VQF(step_s).updateBatch(*readings)
        wxyz = found["quat9D" if magnetic else "quat6D"]
        start = Rotation.from_quat(own.xyzw[0]) * Rotation.from_quat(wxyz[0], scalar_first=True).inv()
        xyzw = turned(nwu_from("ENU") if magnetic else _about_up(start), wxyz)
        at: IntArray | slice = slice(None)
        if place is not None:
            self._uneven += len(stretch)
            xyzw = Slerp(np.arange(len(xyzw)), Rotation.from_quat(xyzw))(place).as_quat()
            at = np.rint(place).astype(np.int64)
        disturbed = np.zeros(len(stretch), dtype=bool)
        if magnetic:
            disturbed = found["magDistDetected"][at]
            self._fields.append(not disturbed.all())
        apart = _apart_variance(xyzw, own.xyzw, float(np.mean(stretch.step_s)))
        sd = np.minimum(np.sqrt(own.sd_rad**2 + apart), np.pi)
        resting = found["restDetected"][at]
        return Estimate(xyzw, sd, found["bias"][at], disturbed, resting, own.field_stray, own.field_iron)


def _about_up(turn: Rotation) -> Rotation:
    """That part of a rotation that is about up."""
    return Rotation.from_rotvec([0.0, 0.0, 2.0 * np.arctan2(*turn.as_quat()[2:])])


# -- what VQF wants


def _field_carried(stretch: Samples, xyzw: FloatArray) -> FloatArray:
    """The field, each hole filled with the reading before it, or the first, which stays in the world."""
    there = np.asarray(np.isfinite(stretch.field_au).all(axis=1))
    if there.all():
        return stretch.field_au
    last = np.maximum.accumulate(np.where(there, np.arange(len(there)), np.argmax(there)))
    turns = Rotation.from_quat(xyzw)
    return np.asarray(turns.inv().apply(turns[last].apply(stretch.field_au[last])))


def _even_clock(vectors: list[FloatArray], steps_s: FloatArray) -> _Even:
    """Rate, force and perhaps field of a stretch on an even clock: unchanged if theirs is one.

    A gyroscope's reading is the mean rate since the sample before; on the new clock, too, so that the turn
    from end to end stays what it was. Accelerometer and field are interpolated.
    """
    time_s, last = np.cumsum(steps_s) - steps_s[0], len(steps_s) - 1
    if last == 0:
        return _Even(vectors, float(steps_s[0]), None)
    step_s = float(time_s[-1]) / last
    off = np.abs(time_s / step_s - np.arange(last + 1)).max()
    if off < _EVEN:
        return _Even(vectors, step_s, None)
    if off > 0.5:
        # Samples were lost. A clock of bursts has a median step far below the mean: at most two for one.
        last = max(1, round(float(time_s[-1]) / max(float(np.median(steps_s)), 0.5 * step_s)))
        step_s = float(time_s[-1]) / last
    grid_s = step_s * np.arange(last + 1.0)
    rate = vectors[0]
    angle = np.vstack([np.zeros(3), np.cumsum(rate[1:] * steps_s[1:, None], axis=0)])
    mean = np.vstack([rate[:1], np.diff(_at(grid_s, time_s, angle), axis=0) / step_s])
    others = [_at(grid_s, time_s, values) for values in vectors[1:]]
    return _Even([mean, *others], step_s, np.minimum(time_s / step_s, last))


def _at(grid_s: FloatArray, time_s: FloatArray, values: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(grid_s, time_s, axis) for axis in values.T])


# -- uncertainty


def _apart_variance(xyzw: FloatArray, other: FloatArray, step_s: float) -> FloatArray:
    """Squared distance of two orientations about the world's axes, shape (m, 3): past mean or now."""
    stride = max(1, round(_COMPARED_S / step_s))
    one, two = (Rotation.from_quat(each[::stride]) for each in (xyzw, other))
    square = (one * two.inv()).as_rotvec() ** 2
    keep = math.exp(-stride * step_s / _AVERAGED_S)
    mean, _ = lfilter([1.0 - keep], [1.0, -keep], square, axis=0, zi=keep * square[:1])
    return np.repeat(np.maximum(mean, square), stride, axis=0)[: len(xyzw)]
