"""VQF (Laidig and Seel, Information Fusion 91, 2023) as an engine beside the filter of this package.

VQF wants an even clock, a field at every sample, and gives no standard deviation of the orientation. Here its
samples are brought to an even clock where the log's is not, missing fields are carried by the orientation of
this package's own engine, and what that engine claims, and how far VQF is from it, become VQF's deviation.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.fusion.readings import Estimate, Samples
from xsens.logs.worlds import nwu_from

_EVEN = 0.05
"""Largest distance of a sample from its place on an even clock, in steps, that is left as it is: at 5 rad/s
and 100 samples/s it is 0.15 degrees, and does not add up."""


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

    @property
    def notes(self) -> list[str]:
        """What VQF made of the log, for those who see the orientation."""
        notes = []
        if self._uneven:
            notes.append(
                f"VQF wants an even clock: {self._uneven} samples between pauses interpolated to one"
            )
        return notes

    def run(self, stretch: Samples, own: Estimate, offline: bool) -> Estimate:
        """Find the orientation of a stretch.

        Parameters
        ----------
        stretch : Samples
        own : Estimate
            The same by this package's engine: its variances, plus the squared distance of VQF from it about
            each of the world's axes, are VQF's variances.
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
        apart = (turns * Rotation.from_quat(own.xyzw).inv()).as_rotvec()
        sd = np.minimum(np.hypot(own.sd_rad, apart), np.pi)
        resting = found["restDetected"][at]
        return Estimate(
            turns.as_quat(), sd, found["bias"][at], disturbed, resting, own.field_stray, own.field_iron
        )


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
