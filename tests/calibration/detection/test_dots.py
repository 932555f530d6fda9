import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_scenes import PIXEL_MM, SHAPE, picture, plus_results, scene

from calibration.detection.dots import dots_in_frames, dots_in_image
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.metaimage import read_metaimage
from speckle3d.io.plus_config import read_wire_phantom

NOTHING = np.zeros((0, 2))


def gaussian_dot(place, sds_mm=(0.4, 0.3), pixel_mm=PIXEL_MM, shape=(120, 100)):
    u, v = ((np.arange(n) - p) * size for n, p, size in zip(shape, place, pixel_mm, strict=True))
    return np.exp(-(u[:, None] ** 2) / sds_mm[0] ** 2 / 2 - v[None] ** 2 / sds_mm[1] ** 2 / 2)


@given(u=st.floats(20, 100), v=st.floats(20, 80), gain=st.floats(0.1, 1000), floor=st.floats(-50, 50))
@settings(deadline=None, max_examples=25)
def test_a_dot_is_placed_between_pixels_whatever_the_gain(u, v, gain, floor):
    pixels, score = dots_in_image(gain * (gaussian_dot((u, v)) + floor), PIXEL_MM)
    # A tenth of a pixel: the edge of the part that counts is cut at whole pixels, five to six of them across.
    np.testing.assert_allclose(pixels, [[u, v]], atol=0.1)
    # What the two Gaussians leave of one of these widths: the ratio of the areas before and after.
    sds = np.array([0.4, 0.3])
    kept = [np.prod(sds / np.hypot(sds, s)) for s in (0.35, 1.2)]
    np.testing.assert_allclose(score[0], gain * (kept[0] - kept[1]), rtol=0.03)


def test_wires_are_found_in_speckle_through_side_lobes_and_ringing():
    shown, rng = scene(1, frames=12), np.random.default_rng(0)
    away, ranks = [], []
    for i, true in enumerate(shown.pixels):
        image = picture(true, seed=i, strength=rng.uniform(0.2, 1.5, len(true)))
        pixels, score = dots_in_image(image, PIXEL_MM)
        assert (np.diff(score) <= 0).all()
        apart = np.linalg.norm((pixels[None] - true[:, None]) * PIXEL_MM, axis=2)
        away.append(apart.min(axis=1))
        ranks.append(apart.argmin(axis=1).max())
    # The first ring, a third of the dot 0.7 mm beneath it, moves a mean of all the echo by 0.2 mm.
    assert np.max(away) < 0.2
    # Nine wires, and three in four frames without any candidate before the last of them.
    assert max(ranks) < 12
    assert np.median(ranks) == 8


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.6])
def test_a_wire_is_seen_over_a_floor_that_is_brighter(slope):
    column, row = np.arange(SHAPE[0])[:, None] * PIXEL_MM[0], np.arange(SHAPE[1])[None] * PIXEL_MM[1]
    rng = np.random.default_rng(5)
    floor = np.exp(-((row - 34.0 - slope * (column - 35.0)) ** 2) / 0.3**2 / 2)
    image = np.maximum(
        picture([(250.0, 60.0)], seed=3, strength=[0.1]), 255 * floor * rng.uniform(0.7, 1, (SHAPE[0], 1))
    )
    pixels, _ = dots_in_image(image, PIXEL_MM)
    wire = np.linalg.norm(pixels - [250.0, 60.0], axis=1) < 2.0
    assert wire.sum() == 1
    # The floor has a maximum every 2 mm or so of its 70 mm: left are its ends, and where it is most uneven.
    assert len(pixels) < 10


def test_speckle_alone_shows_hardly_a_dot():
    found = [len(dots_in_image(picture(NOTHING, seed=k, haze=0.1), PIXEL_MM)[0]) for k in range(6)]
    # Some 3000 independent places; five deviations of Gaussian noise would be met in one of 600 images.
    assert sum(found) <= 3


def test_only_the_region_counts():
    true = scene(2, frames=1).pixels[0]
    image = picture(true)
    left, right = true[:, 0].min() - 10, true[:, 0].mean()
    region = [(left, 0), (right, 0), (right, SHAPE[1] - 1), (left, SHAPE[1] - 1)]
    pixels, _ = dots_in_image(image, PIXEL_MM, region_px=region)
    assert len(pixels) >= (true[:, 0] < right).sum()
    assert (pixels[:, 0] < right + 0.5 / PIXEL_MM[0]).all()


@pytest.mark.parametrize(
    ("image", "pixel_mm", "message"),
    [
        (np.zeros((5, 5, 5)), PIXEL_MM, r"image.*\(5, 5, 5\)"),
        (np.zeros((50, 50)), (0.1,), "pixel_mm"),
        (np.full((50, 50), np.nan), PIXEL_MM, r"image\[\(0, 0\)\]"),
    ],
)
def test_images_that_are_none_are_refused(image, pixel_mm, message):
    with pytest.raises(InvalidInputError, match=message):
        dots_in_image(image, pixel_mm)


def test_a_bad_frame_is_named():
    frames = np.zeros((3, 50, 50))
    frames[2, 1, 1] = np.inf
    with pytest.raises(InvalidInputError, match=r"^frame 2: image\[\(1, 1\)\]"):
        dots_in_frames(frames, PIXEL_MM)


@pytest.mark.slow
@pytest.mark.realdata
def test_real_wires_are_found_where_others_found_them(realdata):
    folder = realdata / "plus"
    config = read_wire_phantom(folder / "PlusDeviceSet_fCal_Sim_SpatialCalibration_2.0.xml")
    known = ImportSettings(column_pitch_mm=0.08, row_spacing_mm=0.0745, dynamic_range_db=60.0)
    sweep = read_metaimage(folder / "fCal_Test_Validation_3NWires_fCal2.0.igs.mha", known)
    frames, points, _, _ = plus_results(folder, "Validation")
    away = []
    for frame, point in list(zip(frames, points, strict=True))[::4]:
        pixels, _ = dots_in_image(sweep.frames[frame], [config.pixel_mm] * 2, config.clip_px)
        away.append(np.linalg.norm(pixels[None] - point[:, None], axis=2).min(axis=1))
    # Measured 0.79 px in the middle and 3.9 px at most; a dot's echo is 40 px wide and 13 px high.
    assert np.median(away) < 1.0
    assert np.max(away) < 6.0
