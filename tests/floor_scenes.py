"""A hand that scans the floor of a bath: lines in its images, a tracker that errs, and the truth.

Every motion is a sum of slow sines with a hand's tremor, as a function of time: nothing here interpolates.
"""

import numpy as np
from calibration_examples import BEAM_DOWN, about
from scipy.spatial.transform import RigidTransform, Rotation

MOTIONS = ("tilt", "roll", "yaw", "depth", "x", "y")
"""About the image's x, the beam and up, in degrees; the line's depth in the image and shifts, in mm."""
STILL = dict.fromkeys(("tilt", "roll", "yaw"), 1.0) | {"depth": 2.0}
"""What a hand does that means to hold still."""
TREMOR = np.array([*[0.03] * 3, *[0.15] * 3])
DRIFT_S = 5.0


class Floor:
    """One scan, drawn from a seed, without some of the motions; a level floor has z up in the world."""

    def __init__(self, seed, missing=(), level=False):
        rng = self.rng = np.random.default_rng(seed)
        self.time_s = np.arange(rng.integers(100, 260)) / rng.uniform(4.0, 10.0)
        self.size_mm = np.array([rng.uniform(30.0, 60.0), rng.uniform(50.0, 120.0)])
        self.pixel_mm = rng.uniform(0.08, 0.3, 2)
        self.mounting = RigidTransform.from_components(rng.uniform(-120, 120, 3), Rotation.random(rng=rng))
        rotation = Rotation.identity() if level else Rotation.random(rng=rng)
        self.world_from_floor = RigidTransform.from_components(rng.uniform(-300, 300, 3), rotation)
        reach = dict(zip(MOTIONS, (25.0, 15.0, 60.0, 0.3 * self.size_mm[1], 60.0, 60.0), strict=True))
        reach |= {name: STILL[name] for name in missing}
        self._hertz = np.exp(rng.uniform(np.log(0.05), np.log(0.5), (6, 4)))
        self._tremor_hz, self._phase = rng.uniform(5.0, 10.0, 6), rng.uniform(0.0, 2 * np.pi, (6, 4))
        self._share = rng.uniform(0.4, 1.0, (6, 4))
        swing = self._swing(np.linspace(0.0, self.time_s[-1], 1000))
        self._middle = (swing.min(axis=1) + swing.max(axis=1)) / 2.0
        self._gain = 2.0 * np.array(list(reach.values())) / np.ptp(swing, axis=1)

    def _swing(self, time_s):
        cycles = 2 * np.pi * self._hertz[..., None] * time_s + self._phase[..., None]
        return np.einsum("ij,ijt->it", self._share, np.sin(cycles))

    def image(self, time_s):
        """Pose of the image over the floor at z = 0."""
        tremor = np.sin(2 * np.pi * self._tremor_hz[:, None] * time_s + self._phase[:, :1])
        motion = self._gain[:, None] * (self._swing(time_s) - self._middle[:, None])
        tilt, roll, yaw, depth, x, y = motion + TREMOR[:, None] * tremor
        turn = about(2, np.deg2rad(yaw)) * BEAM_DOWN * about(2, np.deg2rad(roll)) * about(0, np.deg2rad(tilt))
        up = turn.inv().apply([0.0, 0.0, 1.0])
        # The line passes through this depth in the image's middle.
        height = -(up[:, 0] * self.size_mm[0] / 2.0 + up[:, 1] * (self.size_mm[1] / 2.0 + depth))
        return RigidTransform.from_components(np.column_stack([x, y, height]), turn)

    def lines(self, time_s, noise_mm=0.15):
        """Two points of the floor's line in each image, pixels, shape (n, 2, 2)."""
        image, ends = self.image(time_s), np.array([0.0, self.size_mm[0]])
        up = image.rotation.inv().apply([0.0, 0.0, 1.0])
        depth = -(image.translation[:, 2:] + up[:, :1] * ends) / up[:, 1:2]
        depth += noise_mm * self.rng.standard_normal(depth.shape)
        return np.stack([np.broadcast_to(ends, depth.shape), depth], axis=-1) / self.pixel_mm

    def readings(self, time_s, drifts=True):
        """What the tracker says: white errors of 0.15 mm and 0.1 degrees, wandering ones of 0.3 and 0.2."""
        exact = self.world_from_floor * self.image(time_s) * self.mounting.inv()
        wander = self.rng.standard_normal((len(time_s), 6))
        for i, memory in enumerate(np.exp(-np.abs(np.diff(time_s)) / DRIFT_S)):
            wander[i + 1] = memory * wander[i] + np.sqrt(1.0 - memory**2) * wander[i + 1]
        white = self.rng.standard_normal((len(time_s), 6))
        mm, degrees = (
            size * white[:, part] + drifts * drift * wander[:, part]
            for part, size, drift in ((slice(3), 0.15, 0.3), (slice(3, 6), 0.1, 0.2))
        )
        shift, turn = exact.as_components()
        return RigidTransform.from_components(shift + mm, Rotation.from_rotvec(np.deg2rad(degrees)) * turn)
