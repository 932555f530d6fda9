"""Faults found by attacking the checks that the faults of `faults` were written for.

They are subtler: they last for a moment, come halfway, or leave half of a reading right.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from faults import Fault, Honest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation
from tampering import (
    Change,
    all_frames,
    clutter,
    inertial,
    mounted,
    of_images,
    of_orientation,
    of_tracker,
    scaled,
)

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import Sweep

Poses, Random = RigidTransform, np.random.Generator


def _lagging(vectors: np.ndarray, readings: float) -> np.ndarray:
    """First-order low-pass of time constant `readings`."""
    out, keep = vectors.copy(), np.exp(-1.0 / readings)
    for i in range(1, len(out)):
        out[i] = keep * out[i - 1] + (1.0 - keep) * out[i]
    return out


def _lagging_turns(turned: Rotation, rng: Random, readings: float) -> Rotation:
    mean = turned.mean()
    return mean * Rotation.from_rotvec(_lagging((mean.inv() * turned).as_rotvec(), readings))


def _lagging_poses(poses: Poses, rng: Random, readings: float) -> Poses:
    turned = _lagging_turns(poses.rotation, rng, readings)
    return RigidTransform.from_components(_lagging(poses.translation, readings), turned)


def _somewhere(rng: Random, length: float) -> np.ndarray:
    vector = rng.standard_normal(3)
    return length * vector / np.linalg.norm(vector)


def _from_halfway(count: int) -> np.ndarray:
    return np.arange(count) >= count // 2


def _moved_off(poses: Poses, rng: Random, mm: float, readings: int | None = None) -> Poses:
    """Moved from halfway on, for good or for some readings."""
    off = _from_halfway(len(poses))
    if readings is not None:
        off[len(poses) // 2 + readings :] = False
    return RigidTransform.from_components(
        poses.translation + np.outer(off, _somewhere(rng, mm)), poses.rotation
    )


def _rotation_stuck(poses: Poses, rng: Random) -> Poses:
    first = poses.rotation[np.zeros(len(poses), dtype=int)]
    return RigidTransform.from_components(poses.translation, first)


def _position_stuck(poses: Poses, rng: Random) -> Poses:
    return RigidTransform.from_components(np.tile(poses.translation[0], (len(poses), 1)), poses.rotation)


def _last_first(readings: Any, rng: Random) -> Any:
    return readings[np.arange(len(readings))[::-1]]


def _rounded_to_mm(poses: Poses, rng: Random, mm: float) -> Poses:
    return RigidTransform.from_components(mm * np.round(poses.translation / mm), poses.rotation)


def _slipping(poses: Any, rng: Random, degrees: float) -> Any:
    """The sensor turns on the probe halfway."""
    turn = Rotation.from_rotvec(np.outer(_from_halfway(len(poses)), _somewhere(rng, np.deg2rad(degrees))))
    return poses * (RigidTransform.from_rotation(turn) if isinstance(poses, RigidTransform) else turn)


def _heading_step(turned: Rotation, rng: Random, degrees: float) -> Rotation:
    step = np.outer(_from_halfway(len(turned)), [0.0, 0.0, np.deg2rad(degrees)])
    return Rotation.from_rotvec(step) * turned


def _euler_order(turned: Rotation, rng: Random) -> Rotation:
    return Rotation.from_euler("XYZ", turned.as_euler("ZYX")[:, ::-1])


def _other_signs(turned: Rotation, rng: Random) -> Rotation:
    """q and -q in turns, which are the same rotation."""
    signs = np.where(rng.random((len(turned), 1)) < 0.5, -1.0, 1.0)
    return Rotation.from_quat(signs * turned.as_quat(scalar_first=True), scalar_first=True)


def _z_down(turned: Rotation, rng: Random) -> Rotation:
    return Rotation.from_euler("x", 180.0, degrees=True) * turned


def _persistent(frames: np.ndarray, rng: Random, share: float) -> np.ndarray:
    """Each frame averaged with those shown before, as a scanner's persistence does."""
    out = frames.copy()
    for i in range(1, len(out)):
        out[i] = share * out[i - 1] + (1.0 - share) * frames[i]
    return out


def _noisy(frames: np.ndarray, rng: Random, snr_db: float) -> np.ndarray:
    """Noise of the echoes' band."""
    white = rng.standard_normal(frames.shape)
    noise = gaussian_filter1d(white, 1.0, axis=2) - gaussian_filter1d(white, 3.0, axis=2)
    return frames + frames.std() * 10.0 ** (-snr_db / 20.0) * noise / noise.std()


def _still_above(frames: np.ndarray, rng: Random, share: float) -> np.ndarray:
    """Reverberation in the near field: the top of the image does not change."""
    out, top = frames.copy(), int(share * frames.shape[2])
    out[:, :, :top] = frames[0, :, :top]
    return out


def _with_clutter(frames: np.ndarray, rng: Random, level_db: float) -> np.ndarray:
    return frames + 10.0 ** (level_db / 20.0) * (clutter(frames, rng) - frames)


def _closed_up(sweep: Sweep, rng: Random) -> Sweep:
    """15 % of the frames lost, and the rest stamped as if none were."""
    kept = np.sort(rng.choice(len(sweep), int(0.85 * len(sweep)), replace=False))
    truth = None if sweep.truth is None else sweep.truth[kept]
    return replace(
        sweep, frames=all_frames(sweep)[kept], frame_time_s=sweep.frame_time_s[: kept.size], truth=truth
    )


def _frame_rate(sweep: Sweep, factor: float) -> Sweep:
    times = sweep.frame_time_s
    return replace(sweep, frame_time_s=times[0] + factor * (times - times[0]))


def _of_power(curves: DecorrelationCurves, power: float) -> DecorrelationCurves:
    return replace(curves, correlation=curves.correlation**power)


def _tracker(name: str, honest: Honest, change: Change, *suspects: str) -> Fault:
    return Fault(f"tracker {name}", "tracker", suspects, ("sign", "pose"), honest, change)


def _orientation(name: str, honest: Honest, change: Change, *suspects: str) -> Fault:
    return Fault(
        f"orientation {name}", "orientation sensor", suspects, ("sign", "orientation"), honest, change
    )


def _images(name: str, honest: Honest, change: Change) -> Fault:
    return Fault(name, "images", (), ("image", "orientation", "pose"), honest, change)


RARE = (
    _tracker("lags by a filter of 15 readings", "say", of_tracker(_lagging_poses, 15.0)),
    _tracker("moved by 10 mm from halfway", "say", of_tracker(_moved_off, 10.0)),
    _tracker("moved by 3 mm from halfway", "say", of_tracker(_moved_off, 3.0)),
    _tracker("off by 30 mm for ten readings", "say", of_tracker(_moved_off, 30.0, 10), "spike", "jump"),
    _tracker("off by 5 mm for ten readings", "say", of_tracker(_moved_off, 5.0, 10), "spike", "jump"),
    _tracker("rotations stuck", "refuse", of_tracker(_rotation_stuck), "frozen"),
    _tracker("positions stuck", "refuse", of_tracker(_position_stuck), "frozen"),
    _tracker("last reading first", "refuse", of_tracker(_last_first)),
    _tracker("rounded to 1 mm", "stand", of_tracker(_rounded_to_mm, 1.0)),
    _tracker("rounded to 5 mm", "say", of_tracker(_rounded_to_mm, 5.0)),
    _tracker("slips by 10 deg halfway", "refuse", of_tracker(_slipping, 10.0)),
    _tracker("slips by 4 deg halfway", "say", of_tracker(_slipping, 4.0)),
    _tracker("x -1", "refuse", of_tracker(scaled, -1.0)),
    _tracker("x 2", "refuse", of_tracker(scaled, 2.0), "unit", "scale"),
    _tracker(
        "mount 100 mm off",
        "stand",
        mounted("tracker", lambda mount: mount * RigidTransform.from_translation([58.0, 58.0, 58.0])),
    ),
    _orientation("lags by a filter of 30 readings", "say", of_orientation(_lagging_turns, 30.0)),
    _orientation("heading steps by 15 deg", "say", of_orientation(_heading_step, 15.0)),
    _orientation("slips by 10 deg halfway", "say", of_orientation(_slipping, 10.0)),
    _orientation("Euler angles in another order", "refuse", of_orientation(_euler_order)),
    _orientation("last reading first", "say", of_orientation(_last_first)),
    _orientation("q and -q in turns", "stand", of_orientation(_other_signs)),
    _orientation("world's z down", "stand", of_orientation(_z_down)),
    _orientation("gyroscope of the other sign", "stand", inertial("gyroscope_rad_s", -1.0)),
    _orientation("accelerometer of the other sign", "stand", inertial("accelerometer_m_s2", -1.0)),
    _images("persistence of 0.5", "say", of_images(lambda frames, rng: _persistent(frames, rng, 0.5))),
    _images("persistence of 0.8", "say", of_images(lambda frames, rng: _persistent(frames, rng, 0.8))),
    _images("noise at 10 dB", "stand", of_images(lambda frames, rng: _noisy(frames, rng, 10.0))),
    _images("noise at 3 dB", "say", of_images(lambda frames, rng: _noisy(frames, rng, 3.0))),
    _images("top third still", "say", of_images(lambda frames, rng: _still_above(frames, rng, 1 / 3))),
    _images(
        "static clutter at -6 dB", "say", of_images(lambda frames, rng: _with_clutter(frames, rng, -6.0))
    ),
    _images(
        "static clutter at -10 dB", "say", of_images(lambda frames, rng: _with_clutter(frames, rng, -10.0))
    ),
    _images("frames lost and closed up", "say", _closed_up),
    _images("frame rate doubled", "say", lambda sweep, rng: _frame_rate(sweep, 0.5)),
    Fault("curves squared", "curves", (), ("image",), "say", change_curves=lambda c: _of_power(c, 2.0)),
    Fault("curves' root", "curves", (), ("image",), "say", change_curves=lambda c: _of_power(c, 0.5)),
)
