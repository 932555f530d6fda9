"""Sweeps whose images are not what they are taken for, made of good ones."""

from dataclasses import replace

import numpy as np
from scipy import fft


def spoiled(sweep, frames, order=None):
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


def narrowed(sweep):
    """The first 24 vectors of a sweep, held in memory."""
    frames = np.stack([sweep.frames[k][:24] for k in range(len(sweep))]).astype(np.float32)
    return spoiled(replace(sweep, frames=frames, grid=replace(sweep.grid, vectors=24)), frames)


def shadowed(sweep, columns, rows):
    """A bone's shadow: nothing but fresh noise of 3 counts in some vectors and samples of every frame."""
    rng = np.random.default_rng(5)
    frames = np.array([sweep.frames[k] for k in range(len(sweep))], np.float32)
    frames[:, columns, rows] *= 0.002
    return spoiled(sweep, np.rint(frames + rng.normal(0.0, 3.0, frames.shape)))


def in_order(sweep, order):
    """Frames of a sweep in another order, some of them twice or not at all."""
    return spoiled(sweep, sweep.frames[np.asarray(order)], order)


def level_by_depth(frames):
    """Root mean square of a sweep's samples at each depth, smooth."""
    power = np.square(frames).mean(axis=(0, 1))
    return np.sqrt(np.convolve(power, np.full(201, 1 / 201), "same"))


def band_noise(rng, sweep, shape):
    """Noise in the signal's band, of unit power, each vector its own."""
    low, high = sweep.signal.bandwidth_hz
    spectrum = fft.rfft(rng.standard_normal(shape), axis=-1)
    frequency = fft.rfftfreq(shape[-1], 1 / sweep.signal.sampling_rate_hz)
    noise = fft.irfft(spectrum * ((frequency > low) & (frequency < high)), shape[-1], axis=-1)
    return noise / noise.std()


def noisy(sweep, snr_db):
    """Fresh noise added to every frame, as strong at each depth as the signal is, less `snr_db`."""
    rng, level = np.random.default_rng(1), level_by_depth(sweep.frames)
    noise = np.stack([band_noise(rng, sweep, frame.shape) for frame in sweep.frames])
    return spoiled(sweep, sweep.frames + 10 ** (-snr_db / 20) * level * noise)


def at_rest(sweep, snr_db):
    """A probe that rests on the first frame's tissue, with fresh noise in every frame."""
    order = np.zeros(len(sweep), dtype=int)
    level = sweep.frames[:1]
    still = noisy(replace(sweep, frames=np.repeat(level, len(sweep), axis=0)), snr_db)
    return replace(still, truth=sweep.truth[order])


def cluttered(sweep, pattern):
    """The same pattern added to every frame, as strong at each depth as the signal is."""
    pattern = pattern / np.maximum(level_by_depth(pattern[None]), 1e-9)
    return spoiled(sweep, sweep.frames + level_by_depth(sweep.frames) * pattern)


def interleaved(*sweeps):
    """Frames of several sweeps taken in turn."""
    count = min(map(len, sweeps))
    frames = np.stack([each.frames[:count] for each in sweeps], axis=1).reshape(
        -1, *sweeps[0].frames.shape[1:]
    )
    return spoiled(sweeps[0], frames, np.repeat(np.arange(count), len(sweeps)))


def resting_first(sweep, share=1 / 3):
    """A sweep that begins with a rest of a share of its time."""
    rest = round(len(sweep) * share / (1 - share))
    return in_order(sweep, np.concatenate([np.zeros(rest, dtype=int), np.arange(len(sweep))]))
