"""Lines of a floor's echo in images made from scatterers by a beam: no edge, no line, no model of either."""

import numpy as np
import pytest

from calibration.detection.lines import LineFinder
from calibration.settings import LineSettings
from speckle3d.core.errors import InsufficientDataError

PIXEL_MM = (0.25, 0.08)
FRONT = LineSettings(place="front")
"""The steadiest place in speckle; where a scatterer's echo is, is known for it."""
SHAPE = (160, 300)
WAVELENGTH_MM = 0.3
BEAM_MM, PULSE_MM = 0.45, 0.16
RANGE_DB = 60.0

LEAD_MM = PULSE_MM * np.sqrt(2 * np.log(10 ** (RANGE_DB / 2 / 20)))
"""How far above a scatterer its echo has half of all grey levels: 0.42 mm."""


def echoes(groups):
    """Amplitude of scatterers seen by Gaussian beams and pulses; groups of (points in mm, strength, beam)."""
    points = np.concatenate([group[0] for group in groups])
    strength = np.concatenate([group[1] for group in groups])
    beam = np.concatenate([np.full(len(group[0]), group[2]) for group in groups])
    x, y = (np.arange(n)[:, None] * pixel for n, pixel in zip(SHAPE, PIXEL_MM, strict=True))
    across = np.exp(-(((x - points[:, 0]) / beam) ** 2) / 2)
    along = np.exp(-(((y - points[:, 1]) / PULSE_MM) ** 2) / 2)
    return (across * strength * np.exp(-4j * np.pi / WAVELENGTH_MM * points[:, 1])) @ along.T


def floor_echo(
    seed,
    depth_mm=10.0,
    degrees=5.0,
    rough_mm=0.3,
    brightness=np.ones_like,
    reverberation=0.3,
    lobes=0.02,
    haze=0.05,
    noise=0.003,
):
    """Amplitude (column, row) of a floor through `depth_mm` in the image's middle, sinking by `degrees`.

    Its scatterers lie from the floor to some `rough_mm` beneath; `brightness` is their amplitude by place
    across (0 to 1). Echoes come again beneath, the wide side lobes show the floor above it, and there are
    echoes of anything in the water.
    """
    rng = np.random.default_rng(seed)
    width, height = np.multiply(SHAPE, PIXEL_MM)
    x = rng.uniform(-2.0, width + 2.0, int(12 * width))
    y = depth_mm + np.tan(np.radians(degrees)) * (x - (SHAPE[0] - 1) * PIXEL_MM[0] / 2)
    strength = (rng.normal(size=x.size) + 1j * rng.normal(size=x.size)) * brightness(x / width)
    floor = np.stack([x, y + rng.exponential(rough_mm, x.size)], axis=1)
    dust = rng.uniform([0, 0], [width, height], (int(width * height / 4), 2))
    groups = [
        (floor, strength, BEAM_MM),
        (floor * [1, 1.35], reverberation * strength, BEAM_MM),
        (floor * [1, 1.7], reverberation**2 * strength, BEAM_MM),
        (floor * [1, 0.8], lobes * strength, 2.0),
        (dust, haze * rng.normal(size=len(dust)), BEAM_MM),
    ]
    hiss = rng.normal(size=(2, *SHAPE))
    return np.abs(echoes(groups) + noise * (hiss[0] + 1j * hiss[1])) / 4


def floor_image(seed, *arguments, **keywords):
    decibels = 20 * np.log10(floor_echo(seed, *arguments, **keywords) + 1e-12)
    return np.clip(255 * (1 + decibels / RANGE_DB), 0, 255).astype(np.uint8)


def too_deep_mm(line, depth_mm, degrees):
    """How far each of the line's two points lies beneath the floor."""
    x, y = (line.points_px * PIXEL_MM).T
    return y - depth_mm - np.tan(np.radians(degrees)) * (x - (SHAPE[0] - 1) * PIXEL_MM[0] / 2)


def detect_line(image, settings=None):
    return LineFinder.of_frames(image[None], PIXEL_MM, settings).line(image)


@pytest.mark.parametrize(
    ("conditions", "degrees"),
    [
        ({"noise": 0.05}, -14.0),
        ({"haze": 0.15, "lobes": 0.04}, 12.0),
        ({"reverberation": 1.0}, -14.0),
        ({"brightness": lambda place: np.where(np.abs(place - 0.4) > 0.12, 1.0, 0.0)}, 12.0),
    ],
    ids=["noise", "haze", "reverberations as bright", "drop-out"],
)
def test_a_floor_is_found_where_it_is(conditions, degrees):
    line = detect_line(floor_image(1, 10.0, degrees, **conditions), FRONT)
    # Ahead of the floor by no more than its own pulse, and by four standard errors (0.02 mm).
    assert -LEAD_MM - 0.08 < too_deep_mm(line, 10.0, degrees).mean() < 0.08
    x, y = np.diff(line.points_px * PIXEL_MM, axis=0)[0]
    assert abs(np.degrees(np.arctan2(y, x)) - degrees) < 0.3  # four standard errors of a rough floor's, 0.07
    assert 0.7 * line.possible <= line.consensus <= line.possible <= 61


def test_places_on_an_echo():
    image = floor_image(4, 10.0, 3.0, rough_mm=0.1)
    depths = [
        too_deep_mm(detect_line(image, LineSettings(place=place)), 10.0, 3.0).mean()
        for place in ("slope", "front", "peak")
    ]
    assert -0.7 - LEAD_MM / 2 < depths[0] < depths[1] < depths[2]
    assert abs(depths[1] + LEAD_MM) < 0.2
    assert abs(depths[2]) < 0.2  # a rough floor's own depth and half


def test_images_without_a_line():
    noise = [np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8) for seed in range(20)]
    darker = np.tile(np.arange(300, 0, -1.0), (160, 1))
    for image in (*noise, darker, np.zeros(SHAPE), np.where(np.eye(*SHAPE) > 0, np.nan, floor_echo(0))):
        with pytest.raises(InsufficientDataError):
            detect_line(image, FRONT)
