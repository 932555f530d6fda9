"""How large the errors of images and sensors are: means over grids, by restricted likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.fused.images import ErrorSize
from speckle3d.correction.fused.sensors import SensorEvidence

WANDER = (0.05, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Sizes tried of a tracker's wandering error over its jitter; the first stands for none."""
WANDER_TIMES_S = (1.0, 5.0, 20.0)
STEADY = 0.5
"""Probability, before anything is measured, that a tracker does not wander."""
FACTORS = (0.25, 0.5, 1.0, 2.0)
"""Sizes tried of an orientation sensor's wandering error over the expected."""
FACTOR_SPREAD = 0.5
"""Standard deviation of the logarithm of that factor among sensors: twice, or half."""
GROWN = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Sizes tried of the images' errors over those claimed, and how probable each is over the one before: a
probe that is turned on purpose turns several times as far as images expect."""
LESS_LIKELY = 0.4
SAME = np.ones(3)


@dataclass(frozen=True)
class Wander:
    """Size, shape (components,), and time of a sensor's wandering error."""

    sigma: FloatArray
    time_s: float


@dataclass(frozen=True)
class Sizes:
    """Sizes of all errors that are found."""

    images: ErrorSize
    wander: tuple[Wander, ...]


@dataclass(frozen=True)
class Grid:
    """Alternatives of some of the sizes, and their probabilities beforehand."""

    sizes: tuple[Sizes, ...]
    prior: FloatArray

    def mean(self, likelihood: FloatArray) -> Sizes:
        """Means given logarithms of likelihoods: geometric of factors, of wander that of its square."""
        weight = self.prior * np.exp(likelihood - likelihood.max())
        weight /= weight.sum()

        def of(values: list[FloatArray]) -> FloatArray:
            return np.asarray(np.exp(np.tensordot(weight, np.log(values), 1)))

        images = ErrorSize(
            of([each.images.common for each in self.sizes]), of([each.images.changing for each in self.sizes])
        )
        wander = tuple(
            Wander(
                np.sqrt(weight @ np.square([each.wander[k].sigma for each in self.sizes])),
                float(np.exp(weight @ np.log([each.wander[k].time_s for each in self.sizes]))),
            )
            for k in range(len(self.sizes[0].wander))
        )
        return Sizes(images, wander)


def steady(sensor: SensorEvidence) -> Wander:
    """What a tracker's wandering error is before it is found: next to nothing."""
    return Wander(WANDER[0] * np.repeat(sensor.jitter, 3), WANDER_TIMES_S[-1])


def turns(sizes: Sizes) -> Grid:
    """How far the images' tilt and yaw are off on the whole: any size, as a probe is turned at will."""
    found = [_grown(sizes, common=np.array([1.0, factor, factor])) for factor in GROWN]
    return Grid(tuple(found), np.ones(len(GROWN)))


def turn_changes(sizes: Sizes) -> Grid:
    """How far the images' tilt and yaw are off from place to place."""
    found = [_grown(sizes, changing=np.array([1.0, factor, factor])) for factor in GROWN]
    return Grid(tuple(found), LESS_LIKELY ** np.arange(float(len(GROWN))))


def scale_changes(sizes: Sizes) -> Grid:
    """How much the images' scale changes along the sweep."""
    found = [_grown(sizes, changing=np.array([factor, 1.0, 1.0])) for factor in GROWN]
    return Grid(tuple(found), LESS_LIKELY ** np.arange(float(len(GROWN))))


def _grown(sizes: Sizes, common: FloatArray = SAME, changing: FloatArray = SAME) -> Sizes:
    """Sizes with those of the images' errors multiplied, where a factor is not one."""
    return replace(sizes, images=ErrorSize(sizes.images.common * common, sizes.images.changing * changing))


def wanders(sizes: Sizes, number: int, sensor: SensorEvidence, expected: Wander | None) -> Grid:
    """How one sensor wanders; `expected` is None if only its readings tell."""
    if expected is None:
        jitter = np.repeat(sensor.jitter, 3)
        pairs = [(size, time) for size in WANDER for time in WANDER_TIMES_S]
        tried = [Wander(size * jitter, time) for size, time in pairs]
        moving = (1.0 - STEADY) / (len(WANDER) - 1)
        prior = np.array([STEADY if size == WANDER[0] else moving for size, _ in pairs])
    else:
        both = [(a, b) for a in FACTORS for b in FACTORS]
        tried = [Wander(expected.sigma * [a, a, b], expected.time_s) for a, b in both]
        prior = np.exp(-0.5 * (np.log(np.array(both)) ** 2).sum(axis=1) / FACTOR_SPREAD**2)
    found = []
    for wander in tried:
        every = (*sizes.wander[:number], wander, *sizes.wander[number + 1 :])
        found.append(replace(sizes, wander=every))
    return Grid(tuple(found), prior)
