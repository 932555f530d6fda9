"""Calibration from two sweeps: what is refused, and whether the errors claimed for the rest are true.

Tissue, probe, mounting, motion and the tracker's errors are drawn anew for each trial; the simulation is that
of `_sweep_scenes`. Starts are off by up to 1.5 mm and degrees in each parameter, or by 20 in some.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.images.angulation import angulation
from calibration.images.solver import calibrate_images
from calibration.settings import ImageFit
from calibration_errors._sweep_scenes import Scene, SceneSettings, scene
from calibration_errors.rows import Row, trials
from speckle3d.core.errors import InsufficientDataError

OTHER_THAN_LAYERS = ("blobs", "tubes", "mixture")
USUAL_DRIFT = 0.35
"""Displaces one sweep against the other by 0.15 mm and 0.1 degrees, as the calibration takes for granted."""


@dataclass(frozen=True)
class Setup:
    """One row of the table: ranges that its trials are drawn from.

    Parameters
    ----------
    trials : int
        At share 1.
    kinds : tuple of str
        Of tissue.
    crossing_deg, fan_deg : tuple of float
        Ranges.
    drift : float
        Of the tracker, see `SceneSettings`; the calibration is told of what is more than usual.
    contrast : float
        Of the tissue.
    far : bool
        Start up to 20 mm and degrees off in each parameter.
    must : str
        "refuse" or "accept", or neither.
    """

    case: str
    trials: int
    kinds: tuple[str, ...] = OTHER_THAN_LAYERS
    crossing_deg: tuple[float, float] = (70.0, 90.0)
    fan_deg: tuple[float, float] = (35.0, 50.0)
    drift: float = USUAL_DRIFT
    contrast: float = 1.0
    far: bool = False
    must: str = ""


SETUPS = (
    Setup("parallel", 36, (*OTHER_THAN_LAYERS, "layers"), (0.0, 3.0), (0.0, 50.0), must="refuse"),
    Setup("crossing without fan", 16, crossing_deg=(60.0, 90.0), fan_deg=(0.0, 8.0)),
    Setup("layers alone", 16, ("layers",)),
    Setup(
        "crossing by 12 to 60 degrees, fans of 12 to 35", 16, crossing_deg=(12.0, 60.0), fan_deg=(12.0, 35.0)
    ),
    Setup("good", 24, contrast=1.4, must="accept"),
    Setup("good, start 20 mm and 20 degrees off", 6, contrast=1.4, far=True, must="accept"),
    Setup("tracker drifts by 0.3 mm, 0.2 degrees over 5 s, and is said to", 8, drift=1.0),
)


@dataclass(frozen=True)
class Outcome:
    """Errors of turns (degrees) and of the image's centre (mm), and those claimed; empty where refused."""

    error: np.ndarray
    claimed: np.ndarray

    @property
    def accepted(self) -> bool:
        """Whether there was an answer."""
        return self.error.size > 0


def measure(share: float, first_seed: int) -> list[Row]:
    """Run every set-up."""
    todo, counts = [], []
    for number, setup in enumerate(SETUPS):
        counts.append(max(2, round(share * setup.trials)))
        todo += [(setup, first_seed + 1000 * number + k) for k in range(counts[-1])]
    done = trials(_attempt, todo)
    ends = np.cumsum(counts)
    return [_row(setup, done[end - n : end]) for setup, n, end in zip(SETUPS, counts, ends, strict=True)]


def _attempt(todo: tuple[Setup, int]) -> Outcome:
    setup, seed = todo
    rng = np.random.default_rng(seed)
    kind = setup.kinds[int(rng.integers(len(setup.kinds)))]
    made = scene(
        SceneSettings(
            seed,
            kind,
            rng.uniform(*setup.crossing_deg),
            rng.uniform(*setup.fan_deg),
            setup.contrast,
            setup.drift,
        )
    )
    try:
        return _calibrated(made, setup)
    except InsufficientDataError:
        return Outcome(np.empty(0), np.empty(0))


def _calibrated(made: Scene, setup: Setup) -> Outcome:
    """As the command does it: the motion is judged first at the start."""
    start = made.far_start if setup.far else made.near_start
    poses = [each.world_from_sensor(each.covered()) for each in (made.first, made.second)]
    grid = made.first.grid
    angulation(*poses, start, grid.corners_mm).require(0.5)
    reach = {} if setup.far else {"capture_mm": 0.0, "capture_deg": 0.0}
    # What two sweeps' errors differ by.
    more = np.sqrt(2.0) * setup.drift
    tracker = {"tracker_mm": 0.3 * more, "tracker_deg": 0.2 * more} if setup.drift > USUAL_DRIFT else {}
    found = calibrate_images(made.first, made.second, start, ImageFit(**reach, **tracker))
    off = made.truth.inv() * found.sensor_from_image
    centre = grid.centre_mm
    error = np.concatenate([np.rad2deg(off.rotation.as_rotvec()), off.apply(centre) - centre])
    turns = np.rad2deg(np.sqrt(np.diag(found.covariance)[:3]))
    return Outcome(error, np.concatenate([turns, np.sqrt(np.diag(found.covariance_of(centre)))]))


def _row(setup: Setup, outcomes: list[Outcome]) -> Row:
    kept = [one for one in outcomes if one.accepted]
    found, reached = f"{len(outcomes) - len(kept)} of {len(outcomes)} refused", True
    target = {"refuse": "all refused", "accept": "none refused; "}.get(setup.must, "")
    if setup.must == "refuse":
        reached = not kept
    if setup.must == "accept":
        reached = len(kept) == len(outcomes)
    if kept:
        error, claimed = np.array([one.error for one in kept]), np.array([one.claimed for one in kept])
        ratio = np.abs(error / claimed)
        wrong, rms = int((ratio.max(axis=1) > 3.0).sum()), float(np.sqrt(np.mean(ratio**2)))
        typical = np.median(np.abs(error), axis=0)
        found += (
            f"; over 3 claimed errors {wrong}, largest z {ratio.max():.1f}, RMS z {rms:.2f}; median errors "
            f"{typical[:3].max():.2f} deg, {typical[3:].max():.2f} mm"
        )
        reached &= wrong == 0 and rms <= 1.2
    if setup.must != "refuse":
        target += "none over 3 claimed errors, RMS z <= 1.2"
    return Row(setup.case, found, target, reached)
