"""Length and tilt by inertial scale: poses with drawn errors for statistics, RF sweeps for the whole way.

``python tests/benchmarks/length/inertial.py [--first-seed N] [--count N] [--sweeps N] [--cache DIR]``
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from cache import DEFAULT
from inertial_cases import CENTRE_MM, TREMOR, WEAK, WOBBLE, InertialCase, Setup, along, drawn
from rows import Row, show
from scenes import FIRST_SEED, borrowed_curves, wobbled
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.sweep import Sweep
from speckle3d.correction.inertial.scale import correct_inertial
from speckle3d.io.load import load_sweep
from speckle3d.pipeline import Tracked, track

CURVES_SIGMA = 0.1
"""Relative deviation of the images' scale when curves are not the probe's."""


@dataclass(frozen=True)
class Measured:
    """Errors of one answer; None of all where it was refused.

    Attributes
    ----------
    length : float
        Of the length, relative.
    sigma : float
        As claimed.
    tilt_deg : float
        Of the last frame against the first.
    """

    length: float
    sigma: float
    tilt_deg: float


def answer(case: InertialCase) -> Measured | str:
    """Correct one case; the reason if it is refused."""
    try:
        found = correct_inertial(
            case.image, case.covariance, CURVES_SIGMA, case.sensor, case.time_s, CENTRE_MM
        )
    except (InsufficientDataError, MismatchError) as error:
        return str(error)
    return _measured(found.poses, found.log_scale_sigma, case.truth, CENTRE_MM)


def _measured(poses: RigidTransform, sigma: float, truth: RigidTransform, centre_mm: np.ndarray) -> Measured:
    length = along(poses, centre_mm) / along(truth, centre_mm) - 1.0
    ends = [each[0].inv() * each[-1] for each in (truth, poses)]
    tilt, _, _ = (ends[0].inv() * ends[1]).rotation.as_rotvec(degrees=True)
    return Measured(float(length), sigma, abs(float(tilt)))


def figures(found: Sequence[Measured | str], images: Sequence[float]) -> str:
    """Medians, coverage, and what was refused or wrong with confidence."""
    told = [each for each in found if isinstance(each, Measured)]
    if not told:
        return f"all {len(found)} refused"
    length, sigma = (np.array([getattr(each, name) for each in told]) for name in ("length", "sigma"))
    off, tilt = np.abs(length), np.array([each.tilt_deg for each in told])
    before = f"image {100 * np.median(np.abs(images)):.1f} % -> " if len(images) else ""
    # Beyond three claimed deviations, or five per cent where it is fully trusted, nobody would be warned.
    wrong = int(((off > 3.0 * sigma) | ((sigma < 0.02) & (off > 0.05))).sum())
    return (
        f"{before}length {100 * np.median(off):.2f} % (90th {100 * np.quantile(off, 0.9):.2f}), claimed "
        f"{100 * np.median(sigma):.2f}; tilt {np.median(tilt):.2f} deg; within 68 / 95 % intervals "
        f"{np.mean(off < sigma):.0%} / {np.mean(off < 1.96 * sigma):.0%}; {len(found) - len(told)} of "
        f"{len(found)} refused, {wrong} wrong with confidence"
    )


def spoiled(case: InertialCase, seed: int) -> dict[str, InertialCase]:
    """The same case with a sensor that must not be believed, by what is wrong with it."""
    sensor, other = case.sensor, drawn(WOBBLE, seed + 5000).sensor
    force, rate = sensor.accelerometer_m_s2, sensor.gyroscope_rad_s
    mounting = sensor.sensor_from_image
    assert force is not None
    assert rate is not None
    assert mounting is not None
    size = min(len(force), len(other.accelerometer_m_s2))
    swapped = force.copy()
    swapped[:size] = (
        other.accelerometer_m_s2[:size] + force.mean(axis=0) - other.accelerometer_m_s2.mean(axis=0)
    )
    limit = np.quantile(np.abs(rate), 0.9)
    sensors = {
        "accelerometer of another sweep": replace(sensor, accelerometer_m_s2=swapped),
        "accelerometer in g": replace(sensor, accelerometer_m_s2=force / 9.81),
        "gyroscope in degrees/s": replace(sensor, gyroscope_rad_s=np.rad2deg(rate)),
        "gyroscope clipped": replace(sensor, gyroscope_rad_s=np.clip(rate, -limit, limit)),
        "clock 0.2 s off": replace(sensor, time_offset_s=sensor.time_offset_s + 0.2),
        "mounting turned by 90 degrees": replace(
            sensor, sensor_from_image=mounting * Rotation.from_euler("y", 90.0, degrees=True)
        ),
    }
    return {name: replace(case, sensor=each) for name, each in sensors.items()}


def measure(
    first_seed: int = FIRST_SEED, count: int = 64, sweeps: int = 6, folder: Path = DEFAULT
) -> list[Row]:
    """Statistics over `count` cases without images, and `sweeps` RF sweeps of each kind."""
    seeds = range(first_seed, first_seed + count)
    rows = [
        _row(
            "poses, wobble 0.5 mm at 3 Hz, 10 s, 20 to 50 frames/s, levers to 180 mm", WOBBLE, seeds, "1.5 %"
        ),
        _row("poses, tremor 0.05 mm", TREMOR, seeds, "4 %"),
        _row("poses, an ordinary hand", WEAK, seeds[: count // 4], None),
    ]
    rows.append(_spoiled_row(seeds[: max(count // 8, 1)]))
    if sweeps:
        curves = borrowed_curves(22.0, 0.8, folder)
        for kind, target in (("wobble", "1.5 %"), ("tremor", "4 %")):
            found, images = [], []
            for seed in range(first_seed, first_seed + sweeps):
                sweep = load_sweep(wobbled(seed, kind, folder))
                tracked = track(sweep, curves)
                centre = sweep.grid.centre_mm
                assert sweep.truth is not None
                assert sweep.orientation is not None
                images.append(along(tracked.image, centre) / along(sweep.truth, centre) - 1.0)
                found.append(_swept(tracked, sweep))
            rows.append(
                Row(f"RF sweeps, {kind}, curves wrong by 10 %", figures(found, images), _goal(target))
            )
    return rows


def _swept(tracked: Tracked, sweep: Sweep) -> Measured | str:
    centre = sweep.grid.centre_mm
    try:
        found = correct_inertial(
            tracked.image,
            tracked.covariance,
            tracked.scale_sigma,
            sweep.orientation,
            sweep.frame_time_s,
            centre,
        )
    except (InsufficientDataError, MismatchError) as error:
        return str(error)
    return _measured(found.poses, found.log_scale_sigma, sweep.truth, centre)


def _row(name: str, setup: Setup, seeds: Sequence[int], target: str | None) -> Row:
    cases = [drawn(setup, seed) for seed in seeds]
    images = [float(np.exp(-case.log_scale)) - 1.0 for case in cases]
    goal = "refused, or an interval that holds" if target is None else _goal(target)
    return Row(name, figures([answer(case) for case in cases], images), goal)


def _goal(length: str) -> str:
    return f"length <= {length}, tilt <= 0.3 deg, none wrong with confidence"


def _spoiled_row(seeds: Sequence[int]) -> Row:
    found: dict[str, list[Measured | str]] = {}
    for seed in seeds:
        for name, case in spoiled(drawn(WOBBLE, seed), seed).items():
            found.setdefault(name, []).append(answer(case))
    return Row("poses, a sensor that must not be believed", _each(found, _refused), "refused, or right")


def _refused(answers: list[Measured | str]) -> str:
    told = [each for each in answers if isinstance(each, Measured)]
    wrong = sum(abs(each.length) > 3.0 * each.sigma for each in told)
    return f"{len(answers) - len(told)} of {len(answers)} refused, {wrong} wrong"


def _each(found: dict[str, list[Measured | str]], words: Callable[[list[Measured | str]], str]) -> str:
    return "; ".join(f"{name}: {words(answers)}" for name, answers in found.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--sweeps", type=int, default=6)
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    show(measure(options.first_seed, options.count, options.sweeps, options.cache))


if __name__ == "__main__":
    main()
