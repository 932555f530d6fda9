"""Frames on which the method cannot work are told from those on which it can."""

from dataclasses import replace

import numpy as np
import pytest
from speckle import GRID, Speckle, intensity

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.load import load_sweep
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.matching.patches import PatchSettings, lay_patches
from speckle3d.matching.quality import FrameFlag as Flag
from speckle3d.matching.quality import QualitySettings, flag_frames, inspect_frame
from speckle3d.simulation.presets import SimulationSettings, simulate

RAIL = 8191
"""Of 14 bits."""
NOISE_COUNTS = 3.5
"""Electronic noise, 40 dB below the speckle of the simulated receiver (350 counts)."""
BMODE = BModeSettings(60.0)


def features_of(frames, signal, grid):
    extractor = IntensityExtractor(signal, grid)
    patches, is_bmode = lay_patches(extractor.grid), isinstance(signal, BModeSettings)
    with np.errstate(all="ignore"):
        images = [extractor.echo(frame).intensity for frame in frames]
    return [inspect_frame(*pair, patches, is_bmode) for pair in zip(frames, images, strict=True)]


def flags_of(frames, signal, grid):
    return flag_frames(features_of(frames, signal, grid)).tolist()


def counts(samples):
    return np.clip(np.rint(samples), -RAIL, RAIL).astype(np.int16)


def noise(frame):
    # Seeded by the frame, so that the noise is another on each and the same in each run.
    rng = np.random.default_rng(abs(int(frame.astype(np.int64).sum())))
    return counts(rng.normal(0.0, NOISE_COUNTS, frame.shape))


def air(frame, grid):
    """Ring-down between the lens and itself, the same in all vectors, over noise."""
    depth = np.arange(frame.shape[1]) * grid.sample_spacing_mm
    bounces = sum(np.exp(-(((depth - 1.1 * k) / 0.15) ** 2)) for k in range(12))
    echo = 4000 * np.exp(-depth / 4) * bounces * np.cos(2 * np.pi * depth / 0.103)
    return counts(echo + noise(frame))


def lift(frame, grid):
    first = int(3.0 / grid.sample_spacing_mm)
    return np.concatenate([frame[:, :first], noise(frame)[:, first:]], axis=1)


BAD = {
    "clipped": (lambda f, g: counts(30.0 * f), Flag.SATURATED),
    "noise": (lambda f, g: noise(f), Flag.LIFTED),
    "lifted": (lambda f, g: lift(f, g), Flag.LIFTED),
    "air": (air, Flag.LIFTED),
    "black": (lambda f, g: np.zeros_like(f), Flag.NO_SPECKLE),
    "ramp both ways": (
        lambda f, g: counts(
            np.linspace(-3000, 3000, f.shape[0])[:, None] + np.linspace(-4000, 4000, f.shape[1])
        ),
        Flag.NO_SPECKLE,
    ),
}


@pytest.fixture(scope="module")
def phantom(sweep):
    return [sweep.frames[i] for i in range(0, 96, 12)], sweep.signal, sweep.grid


@pytest.fixture(scope="module")
def tissue():
    settings = SimulationSettings(preset="tissue", seed=5, vectors=24, length_mm=4.0, frames=6)
    sweep = simulate(settings)[0].sweep
    return [sweep.frames[i] for i in range(6)], sweep.signal, sweep.grid


@pytest.fixture(params=["phantom", "tissue"])
def good(request):
    return request.getfixturevalue(request.param)


def grey(frame, signal, grid):
    """The frame as a log-compressed image of 60 dB, white 22 dB above the phantom's mean intensity."""
    extractor = IntensityExtractor(signal, grid)
    decibel = 10 * np.log10(extractor.echo(frame).intensity + 1e-9)
    return np.clip(np.rint(255 * (1 + (decibel - 75) / 60)), 0, 255).astype(np.uint8), extractor.grid


def test_good_frames_are_not_flagged(good):
    frames, signal, grid = good
    features = features_of(frames, signal, grid)
    assert not flag_frames(features).any()
    # Tissue holds fascias and fibres finer than a patch in some patches: 0.63 was the least on other seeds.
    assert min(f.speckle_share for f in features) > 0.5
    assert max(f.noise_share for f in features) == 0.0
    assert max(f.clipped for f in features) < 0.01


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_among_good_ones_is_flagged_and_no_other(good, name):
    frames, signal, grid = good
    spoil, flag = BAD[name]
    mixture = [spoil(frame, grid) if i in (1, 4) else frame for i, frame in enumerate(frames)]
    expected = [int(flag) if i in (1, 4) else 0 for i in range(len(frames))]
    assert flags_of(mixture, signal, grid) == expected


def test_only_the_repeat_of_the_frame_before_is_frozen(phantom):
    frames, signal, grid = phantom
    a, b = frames[:2]
    edit = b.copy()
    edit[20, 1700] += 30  # in the band, as an offset of the line would not be
    order = [a, a, b, a, b, b.copy(), b, edit]
    assert flags_of(order, signal, grid) == [0, Flag.FROZEN, 0, 0, 0, Flag.FROZEN, Flag.FROZEN, 0]


@pytest.mark.parametrize(("gain", "saturates"), [(8.0, False), (12.0, True)])
def test_clipping_is_saturation_from_where_distances_are_wrong(phantom, gain, saturates):
    # Speckle of 350 counts in 14 bits: 0.3 and 4.8 % are clipped; the median patch's distance is 0 and 1.7 %
    # too long.
    frames, signal, grid = phantom
    spoilt = [counts(gain * frame) for frame in frames]
    assert flags_of(spoilt, signal, grid) == [Flag.SATURATED if saturates else 0] * len(frames)


def test_a_frame_with_samples_that_are_not_finite_has_no_speckle(phantom):
    frames, signal, grid = phantom
    mixture = [frame.astype(np.float32) for frame in frames]
    mixture[2][5, 1700] = np.nan
    assert flags_of(mixture, signal, grid) == [Flag.NO_SPECKLE if i == 2 else 0 for i in range(len(frames))]


def test_bmode_of_good_frames_is_not_flagged(good):
    frames, signal, grid = good
    images, coarse = zip(*(grey(f, signal, grid) for f in frames), strict=True)
    assert not any(flags_of(images, BMODE, coarse[0]))
    # Black margins of a captured screen take no part, however wide.
    margin = 3 * grid.vectors
    wide = [np.pad(image, ((margin, margin), (0, 0))) for image in images]
    features = features_of(wide, BMODE, replace(coarse[0], vectors=wide[0].shape[0]))
    assert not flag_frames(features).any()
    assert min(f.speckle_share for f in features) > 0.4


MOUSE = ImportSettings(centre_frequency_hz=20e6, bandwidth_hz=(12e6, 28e6), frame_rate_hz=10.0)
ULTRASONIX = ImportSettings(
    sampling_rate_hz=40e6,
    vector_pitch_mm=0.3,
    centre_frequency_hz=5e6,
    bandwidth_hz=(3e6, 7e6),
    demodulation_frequency_hz=0.0,
)
PLUS = ImportSettings(
    column_pitch_mm=0.085, row_spacing_mm=0.085, dynamic_range_db=60.0, tracker_transform="none"
)
REAL = {
    "liver of a mouse, RF": ("rf/MouseLiverRF.mha", MOUSE, 0),
    "spine phantom, B-mode": ("plus/SpinePhantomFreehand.igs.mha", PLUS, 0),
    # No echo but ring-down to 14 mm, the same in all vectors, and noise below: the probe is in air.
    "ring-down, I/Q": ("plus/UltrasonixLinearRfData.igs.mha", ULTRASONIX, Flag.LIFTED),
    "wires in water, B-mode": ("plus/NwirePhantomFreehand.igs.nrrd", PLUS, Flag.NO_SPECKLE),
}


@pytest.mark.realdata
@pytest.mark.parametrize("name", REAL)
def test_real_recordings(realdata, name):
    path, settings, flag = REAL[name]
    sweep = load_sweep(realdata / path, settings)
    frames = [sweep.frames[i] for i in range(0, len(sweep), 1 + len(sweep) // 30)]
    features = features_of(frames, sweep.signal, sweep.grid)
    assert flag_frames(features).tolist() == [int(flag)] * len(frames)
    # Measured: 0.93 or more of the liver's patches, 0.41 of the spine's hold speckle,
    # and at most 0.09 of the others'. The bounds lie midway to the threshold.
    shares = [f.speckle_share for f in features]
    assert max(shares) < 0.12 if flag else min(shares) > 0.28


def test_frames_are_judged_by_the_region_alone():
    """A shadow over most of the image is no frame without speckle where one looks beside it."""
    rng, grid = np.random.default_rng(3), ImageGrid(96, 420, GRID.vector_pitch_mm, GRID.sample_spacing_mm)
    image = intensity(Speckle(rng).image()).astype(np.float32)
    image[12:] = 1e-3 * image[12:].mean() * (1.0 + 0.01 * rng.random(image[12:].shape, np.float32))
    width = 12 * grid.vector_pitch_mm
    region = PatchSettings(region=f"rectangle 0,0 {width},{grid.depth_mm}")
    whole, part = (inspect_frame(image, image, lay_patches(grid, s), True) for s in (None, region))
    assert part.speckle_share > 0.5
    assert whole.speckle_share < QualitySettings().speckle_share
