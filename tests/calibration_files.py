"""Calibrations with everything a calibration file may hold."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.calibration import Calibration, FramesUsed, Parameter, Source

ROTATION = Rotation.from_euler("ZYX", np.deg2rad([-0.55, 44.22, -90.37]))
SPREAD = (0.002, 0.003, 0.004, 0.1, 0.2, 0.3)
"""Standard errors: tilt, yaw and roll in rad, x, y and z in mm."""


def example_calibration(sensor="tracker", **changes):
    calibration = Calibration(
        method="plane",
        sensor="tracker",
        rotation=ROTATION,
        translation_mm=np.array([-270.86, 4.86, -65.08]),
        pixel_mm=np.array([0.137, 0.138]),
        covariance=np.diag(np.square(SPREAD)),
        parameters=(Parameter("s_x", 0.137, 4e-5, "mm/pixel"), Parameter("gamma", 0.5, 0.01, "rad")),
        rms=0.85,
        rms_unit="mm",
        condition_number=211.0,
        frames=FramesUsed(
            9, (0, 1, 4, 8), {2: "no line: 3 of 9", 3: "no line: 4 of 9", 5: "contradicts by 2.5 mm"}
        ),
        time_offset_s=-0.0125,
        verdict="The motion was sufficient.",
        source=Source("plane.mha", "ab" * 32, "0.1.0", '{"columns": 64}'),
    )
    if sensor == "orientation":
        turn = {"method": "orientation", "translation_mm": None, "pixel_mm": None, "rms_unit": "rad"}
        calibration = replace(
            calibration, sensor=sensor, covariance=calibration.covariance[:3, :3], rms=0.01, **turn
        )
    return replace(calibration, **changes)
