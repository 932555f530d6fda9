import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from wire_scenes import ENDS_MM, PIXEL_MM, candidates, cut, n_phantom, scene

from calibration.detection.labelling import label_by_calibration, label_dots, misfits_mm
from calibration.plane import Chain
from calibration.points import Seen

SYMMETRIC_MM = np.array(
    [
        [[30, 0, 10], [30, 40, 10]],
        [[30, 0, 10], [60, 40, 10]],
        [[60, 0, 10], [60, 40, 10]],
        [[30, 0, 0], [30, 40, 0]],
        [[30, 0, 0], [60, 40, 0]],
        [[60, 0, 0], [60, 40, 0]],
    ],
    dtype=float,
)
"""Two equal N over each other: turned half round in the image it looks the same."""


def away_mm(labelled, shown):
    """How far each labelled dot is from where its wire is, at most in column or row."""
    true = shown.pixels[labelled.frame, labelled.wire]
    return np.abs((labelled.pixels - true) * PIXEL_MM).max(axis=1)


NOISE_MM = 0.1
RIGHT_MM = 5 * NOISE_MM
"""Farther than this from its wire a dot is another one: ringing is 1.2 mm off."""


@pytest.mark.parametrize(("seed", "degrees", "wrong"), [(0, 5.0, 1.0), (1, 15.0, 1.05), (2, 30.0, 0.96)])
def test_wires_are_told_apart_among_wrong_dots_however_the_image_lies(seed, degrees, wrong):
    shown = scene(seed, frames=12, degrees=degrees)
    dots = candidates(shown, seed, NOISE_MM)
    labelled = label_dots(dots, shown.phantom, PIXEL_MM * wrong)
    frames, counts = np.unique(labelled.frame, return_counts=True)
    assert set(counts) == {9}
    assert set(frames) | set(labelled.dropped) == set(range(12))
    # Of 1440 such frames none was dropped, and in 7 a wrong dot, stronger and in line, stood for a wire.
    assert len(frames) >= 11
    assert (away_mm(labelled, shown).reshape(-1, 9).max(axis=1) > RIGHT_MM).sum() <= 1


def test_a_phantom_that_looks_the_same_from_two_sides_is_taken_the_usual_way():
    shown = scene(4, frames=5, degrees=8.0, ends=SYMMETRIC_MM)
    labelled = label_dots(candidates(shown, 0, NOISE_MM, wrong=0), shown.phantom, PIXEL_MM)
    assert len(np.unique(labelled.frame)) == 5
    assert away_mm(labelled, shown).max() < RIGHT_MM
    upper, lower = (labelled.pixels[labelled.wire == k] for k in (0, 3))
    assert (upper[:, 1] < lower[:, 1]).all()
    assert (upper[:, 0] > labelled.pixels[labelled.wire == 2][:, 0]).all()


def test_a_frame_says_which_rule_failed_and_by_how_much():
    shown = scene(5, frames=1)

    def reason(pixels):
        dots = Seen(np.zeros(len(pixels), int), pixels)
        return label_dots(dots, shown.phantom, PIXEL_MM).dropped[0]

    right = shown.pixels[0]
    assert "8 dots for 9 wires" in reason(np.delete(right, 4, axis=0))
    assert "narrower than the wires'" in reason(0.7 * right)
    assert "28 % narrower" in reason(right * [1.0, 0.7])
    bent = right + np.where(np.arange(9)[:, None] == 4, [0.0, 2.0 / PIXEL_MM[1]], 0.0)
    assert "two layers" in reason(bent)


def truth(shown):
    return Chain(PIXEL_MM, shown.sensor_from_image, shown.phantom.world_from_phantom.inv())


def test_a_calibration_finds_the_wires_that_show_and_no_others():
    shown = scene(6, frames=6)
    missing = {(2, 4), (4, 0), (4, 1), (4, 2)}
    dots = candidates(shown, 0, NOISE_MM, missing=missing)
    labelled = label_by_calibration(dots, shown.phantom, truth(shown), shown.world_from_sensor)
    pairs = set(zip(labelled.frame.tolist(), labelled.wire.tolist(), strict=True))
    right = away_mm(labelled, shown) < RIGHT_MM
    assert right.sum() == 6 * 9 - 4
    # Ringing under a wire stays within the gate of no other; a wrong dot may fall where a wire is missing.
    assert {pair for pair, r in zip(sorted(pairs), right, strict=True) if not r} <= missing


def test_an_image_that_cuts_wires_fits_them_and_no_others():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)) * Rotation.from_euler("x", -90, degrees=True)
        pose = RigidTransform.from_components([10.0, rng.uniform(15, 25), 30.0], turn)
        dots_mm = (cut(ENDS_MM, pose) * PIXEL_MM / rng.uniform(0.97, 1.03, 2))[None]
        # The ridge on axes that are left open keeps a hundredth of a millimetre.
        assert misfits_mm(dots_mm, np.arange(9), n_phantom())[0] < 0.03
        assert misfits_mm(dots_mm, np.arange(9)[::-1], n_phantom())[0] > 0.5
