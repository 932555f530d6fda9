"""One pass of the filter over a stretch of samples, and what the smoother needs to go back over it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from xsens.fusion import quaternions
from xsens.fusion.errorstate import ErrorStateFilter
from xsens.fusion.increments import Increment, Samples, blocks_of
from xsens.fusion.settings import FusionSettings

_CHUNK = 64
"""Blocks summed with one bias, about two seconds: what it is off by then is corrected to first order."""


@dataclass(frozen=True)
class Step:
    """The filter around one increment; matrices are world from sensor, states without the heading's bias.

    Attributes
    ----------
    increment : Increment
    start : ndarray, shape (3, 3)
        Before the increment.
    start_bias_rad_s : ndarray, shape (3,)
    predicted, predicted_velocity_m_s
        After it, before correction; (3, 3) and (3,).
    matrix, velocity_m_s, bias_rad_s
        After correction; (3, 3), (3,) and (3,).
    covariance, transition, noise : ndarray, shape (12, 12)
        After correction; of the prediction.
    resting, disturbed, started : bool
    """

    increment: Increment
    start: FloatArray
    start_bias_rad_s: FloatArray
    predicted: FloatArray
    predicted_velocity_m_s: FloatArray
    matrix: FloatArray
    velocity_m_s: FloatArray
    bias_rad_s: FloatArray
    covariance: FloatArray
    transition: FloatArray
    noise: FloatArray
    resting: bool
    disturbed: bool
    started: bool


@dataclass(frozen=True)
class Pass:
    """Every step of a stretch, and the turns within the steps.

    Attributes
    ----------
    steps : list of Step
    turns : list of ndarray, shape (samples of the step, 4)
        ``start_from_sample``, scalar first, with the bias of the step's increment.
    time_s : list of ndarray, shape (samples of the step,)
        Since the step's start.
    """

    steps: list[Step]
    turns: list[FloatArray]
    time_s: list[FloatArray]


def forward(
    samples: Samples, settings: FusionSettings, kept: ErrorStateFilter | None = None, pause_s: float = 0.0
) -> tuple[Pass, ErrorStateFilter]:
    """Run the filter over a stretch.

    Parameters
    ----------
    samples : Samples
        Without a pause.
    settings : FusionSettings
    kept : ErrorStateFilter, optional
        The filter of the stretch before, to go on with.
    pause_s : float
        How long ago that ended.
    """
    done = Pass([], [], [])
    kalman = kept
    for part, per_block in _parts(samples, settings):
        blocks = blocks_of(part, per_block, np.zeros(3) if kalman is None else kalman.bias)
        for k, increment in enumerate(blocks):
            if kalman is None:
                kalman = ErrorStateFilter(settings, increment)
            elif not done.steps:
                kalman.resume(increment, pause_s)
            done.steps.append(_step(kalman, increment))
            done.turns.append(blocks.turns_wxyz[k])
            done.time_s.append(np.cumsum(blocks.step_s[k]))
    assert kalman is not None
    return done, kalman


def samples_per_block(step_s: float, settings: FusionSettings) -> int:
    """How many samples make an increment."""
    return max(1, round(settings.block_s / step_s))


def _parts(samples: Samples, settings: FusionSettings) -> Iterator[tuple[Samples, int]]:
    """Runs of whole blocks, then what is left as one block."""
    per_block = samples_per_block(float(np.median(samples.step_s)), settings)
    whole = len(samples) // per_block * per_block
    for first in range(0, whole, _CHUNK * per_block):
        yield samples[first : min(first + _CHUNK * per_block, whole)], per_block
    if whole < len(samples):
        yield samples[whole:], len(samples) - whole


def _step(kalman: ErrorStateFilter, increment: Increment) -> Step:
    start, bias = kalman.matrix, kalman.heading_bias
    kalman.advance(increment)
    predicted, velocity = kalman.predicted
    return Step(
        increment,
        start,
        bias,
        predicted,
        velocity,
        kalman.matrix,
        kalman.velocity,
        kalman.heading_bias,
        kalman.kalman.P,
        kalman.transition,
        kalman.noise,
        kalman.resting,
        kalman.disturbed,
        kalman.started,
    )


def within_steps(
    done: Pass, starts: FloatArray, biases_rad_s: FloatArray, resting: BoolArray
) -> list[FloatArray]:
    """Orientation of every sample, given that at the start of its step, as quaternions (samples, 4) per step.

    Parameters
    ----------
    done : Pass
    starts : ndarray, shape (steps, 4)
        World from sensor, scalar first.
    biases_rad_s : ndarray, shape (steps, 3)
    resting : ndarray of bool, shape (steps,)
        Where the sensor is held still.
    """
    out = []
    for k, step in enumerate(done.steps):
        if resting[k]:
            out.append(np.tile(starts[k], (len(done.turns[k]), 1)))
            continue
        off = step.increment.bias_rad_s - biases_rad_s[k]
        turns = quaternions.product(done.turns[k], quaternions.from_vectors(off * done.time_s[k][:, None]))
        out.append(quaternions.product(starts[k], turns))
    return out
