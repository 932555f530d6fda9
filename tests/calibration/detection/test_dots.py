import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_scenes import PIXEL_MM, picture, scene

from calibration.detection.dots import dots_in_frames


def dots_in(image, *options):
    dots = dots_in_frames(image[None], *options)
    return dots.pixels, dots.score


@given(u=st.floats(20, 100), v=st.floats(20, 80), gain=st.floats(0.1, 1000), floor=st.floats(-50, 50))
@settings(max_examples=25)
def test_a_dot_is_placed_between_pixels_whatever_the_gain(u, v, gain, floor):
    x, y = (
        ((np.arange(n) - at) * mm / sd) ** 2
        for n, at, mm, sd in zip((120, 100), (u, v), PIXEL_MM, (0.4, 0.3), strict=True)
    )
    dots = dots_in_frames(
        gain * (np.exp(-((x[:, None] / 0.4) ** 2 + (y / 0.3) ** 2) / 2) + floor)[None], PIXEL_MM
    )
    # A tenth of a pixel: the edge of the part that counts is cut at whole pixels, five to six of them across.
    np.testing.assert_allclose(dots.pixels, [[u, v]], atol=0.1)


def test_wires_are_found_in_speckle_through_side_lobes_and_ringing():
    wires, rng = scene(1, frames=12), np.random.default_rng(0)
    away, ranks = [], []
    for i, true in enumerate(wires.pixels):
        image = picture(true, seed=i, strength=rng.uniform(0.2, 1.5, len(true)))
        pixels, score = dots_in(image, PIXEL_MM)
        assert (np.diff(score) <= 0).all()
        distance = np.linalg.norm((pixels[None] - true[:, None]) * PIXEL_MM, axis=2)
        away.append(distance.min(axis=1))
        ranks.append(distance.argmin(axis=1).max())
    # The first ring, a third of the dot 0.7 mm beneath it, moves a mean of all the echo by 0.2 mm.
    assert np.max(away) < 0.2
    # Nine wires, and three in four frames without any candidate before the last of them.
    assert max(ranks) < 12
    assert np.median(ranks) == 8


def test_a_repeated_image_is_left_out():
    wires = scene(1, frames=2)
    first, second = (picture(pixels, seed=i) for i, pixels in enumerate(wires.pixels))
    dots = dots_in_frames(np.stack([first, first, second, first]), PIXEL_MM)
    assert list(dots.dropped) == [1]
    assert set(dots.frame) == {0, 2, 3}
