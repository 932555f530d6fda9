"""Sweeps whose images are not what they are taken for, made of good ones."""

from dataclasses import replace

import numpy as np
from sweep_examples import frames_of


def with_frames(sweep, frames, order=None):
    """A sweep of other frames at its own rate, without sensors; `order`: the frames whose truth they have."""
    order = np.arange(len(frames)) if order is None else np.asarray(order)
    step = float(np.median(np.diff(sweep.frame_time_s)))
    return replace(
        sweep,
        frames=np.asarray(frames, dtype=np.float32),
        frame_time_s=step * np.arange(len(frames)),
        truth=sweep.truth[order],
        tracker=None,
        orientation=None,
    )


def first_vectors(sweep):
    """The first 24 vectors of a sweep, held in memory."""
    frames = frames_of(sweep)[:, :24]
    return with_frames(replace(sweep, frames=frames, grid=replace(sweep.grid, vectors=24)), frames)


def shadow(sweep, columns, rows):
    """A bone's shadow: nothing but fresh noise of 3 counts in some vectors and samples of every frame."""
    rng = np.random.default_rng(5)
    frames = frames_of(sweep).astype(np.float32)
    frames[:, columns, rows] *= 0.002
    return with_frames(sweep, np.rint(frames + rng.normal(0.0, 3.0, frames.shape)))


def ringing(sweep, columns):
    """Vectors without contact: ringing that is the same in every frame, and fresh noise."""
    rng = np.random.default_rng(6)
    frames = frames_of(sweep).astype(np.float32)
    sample = np.arange(frames.shape[2])
    frames[:, columns] = 800.0 * np.exp(-sample / 150.0) * np.sin(0.7 * sample)
    return with_frames(sweep, np.rint(frames + rng.normal(0.0, 3.0, frames.shape)))


def text_overlay(sweep):
    """White dots among the letters' strokes, in three blocks of a third of the image by a tenth."""
    rng = np.random.default_rng(7)
    frames = frames_of(sweep).astype(np.float32)
    wide, high = frames.shape[1] // 3, frames.shape[2] // 10
    for vector, sample in ((0, 2 * high), (wide + 8, 4.5 * high), (2, 7 * high)):
        block = np.s_[:, vector : vector + wide, int(sample) : int(sample) + high]
        frames[block][:, rng.random((wide, high)) < 0.02] = 255
    return with_frames(sweep, frames)


def in_order(sweep, order):
    """Frames of a sweep in another order, some of them twice or not at all."""
    return with_frames(sweep, sweep.frames[np.asarray(order)], order)


def level_by_depth(frames):
    """Root mean square of a sweep's samples at each depth, smooth."""
    power = np.square(frames).mean(axis=(0, 1))
    return np.sqrt(np.convolve(power, np.full(201, 1 / 201), "same"))


def at_rest(sweep):
    """A probe that rests on the first frame's tissue, with fresh noise 3 dB below in every frame."""
    level = 10 ** (-3 / 20) * level_by_depth(sweep.frames[:1])
    noise = level * np.random.default_rng(1).standard_normal(sweep.frames.shape)
    return with_frames(sweep, sweep.frames[:1] + noise, np.zeros(len(sweep), dtype=int))


def clutter(sweep, pattern):
    """The same pattern added to every frame, as strong at each depth as the signal is."""
    pattern = pattern / np.maximum(level_by_depth(pattern[None]), 1e-9)
    return with_frames(sweep, sweep.frames + level_by_depth(sweep.frames) * pattern)
