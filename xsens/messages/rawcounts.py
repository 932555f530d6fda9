"""Convert raw counts to units by the calibration block that the sensor keeps and its logs begin with.

The block's layout is not published; it was found by comparing logs with gravity. A vector of counts ``u``
becomes ``M^-1 ((u - b) / g)``. Parts of the block are not understood, among them most likely the dependence
on temperature: expect an error of about 1 % of gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.control import rate_of
from xsens.messages.framing import Message

BLOCK_SIZE = 168
"""Bytes of the payload; blocks of later sensors are longer, in an unknown layout."""

COMPENSATION_NOTE = (
    "raw counts: dependence on temperature is not compensated (expect about 1 % of gravity), "
    "nor the housing's alignment applied"
)

_BLOCK = np.dtype(
    {
        "names": ("inertial", "period", "offsets", "gains", "magnetic"),
        "formats": ((">i2", (2, 3, 3)), ">u2", (">u2", (3, 3)), ("u1", (3, 3, 3)), (">i2", (3, 3))),
        "offsets": (8, 81, 87, 105, 132),
        "itemsize": BLOCK_SIZE,
    }
)
"""Misalignments of accelerometer and gyroscope, and of the magnetometer, over 2**14; gains over 2**8."""


@dataclass(frozen=True)
class RawCalibration:
    """The understood part of a unit's calibration block.

    Attributes
    ----------
    rate_hz : float
        Samples per second; NaN if the block does not hold the period.
    offsets : ndarray, shape (3, 3)
        Counts at zero of accelerometer, gyroscope and magnetometer, each x, y, z.
    gains : ndarray, shape (3, 3)
        Counts per m/s², rad/s and unit of field.
    misalignments : ndarray, shape (3, 3, 3)
        ``sensing axes from sensor axes`` of each of the three sensors.

    Raises
    ------
    InvalidInputError
        If a gain is zero or a misalignment cannot be inverted.
    """

    rate_hz: float
    offsets: FloatArray
    gains: FloatArray
    misalignments: FloatArray

    def __post_init__(self) -> None:
        if not (self.gains > 0.0).all():
            raise InvalidInputError("calibration block: expected gains above 0, got 0")
        # Axes of a real unit are within a few degrees of square: a determinant near 1.
        worst = np.abs(np.linalg.det(self.misalignments)).min()
        if worst < 0.1:
            raise InvalidInputError(
                f"calibration block: expected axes nearly square, got determinant {worst:.2g}"
            )

    @classmethod
    def from_message(cls, message: Message) -> RawCalibration:
        """Decode an eMTS message of `BLOCK_SIZE` bytes."""
        block = np.frombuffer(message.payload, _BLOCK)[0]
        return cls(
            rate_of(int(block["period"])),
            block["offsets"].astype(float),
            block["gains"] @ [256.0, 1.0, 1.0 / 256.0],
            np.concatenate((block["inertial"], block["magnetic"][None])) / 2.0**14,
        )

    def to_units(self, sensor: int, counts: FloatArray) -> FloatArray:
        """Acceleration in m/s², rate in rad/s or field in arbitrary units, of counts, shape (n, 3)."""
        axes = (np.linalg.inv(self.misalignments[sensor]) / self.gains[sensor]).T
        return np.asarray((counts - self.offsets[sensor]) @ axes)
