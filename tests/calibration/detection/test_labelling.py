import numpy as np
import pytest
from wire_scenes import PIXEL_MM, candidates, scene

from calibration.detection.labelling import label_by_calibration, label_dots
from calibration.plane import Chain


def away_mm(labels, wires):
    """How far each labelled dot is from where its wire is, at most in column or row."""
    true = wires.pixels[labels.frame, labels.wire]
    return np.abs((labels.pixels - true) * PIXEL_MM).max(axis=1)


NOISE_MM = 0.1
RIGHT_MM = 5 * NOISE_MM
"""Farther than this from its wire a dot is another one: ringing is 1.2 mm off."""


@pytest.mark.parametrize(("seed", "degrees", "wrong"), [(0, 5.0, 1.0), (1, 15.0, 1.05), (2, 30.0, 0.96)])
def test_wires_are_told_apart_among_wrong_dots_however_the_image_lies(seed, degrees, wrong):
    wires = scene(seed, frames=12, degrees=degrees)
    dots = candidates(wires, seed, NOISE_MM)
    labels = label_dots(dots, wires.phantom, PIXEL_MM * wrong)
    frames, counts = np.unique(labels.frame, return_counts=True)
    assert set(counts) == {9}
    assert set(frames) | set(labels.dropped) == set(range(12))
    # Of 1440 such frames none was dropped, and in 7 a wrong dot, stronger and in line, stood for a wire.
    assert len(frames) >= 11
    assert (away_mm(labels, wires).reshape(-1, 9).max(axis=1) > RIGHT_MM).sum() <= 1


def truth(wires):
    return Chain(
        PIXEL_MM, wires.sensor_from_image.as_matrix(), wires.phantom.world_from_phantom.inv().as_matrix()
    )


def test_a_calibration_finds_the_wires_that_show_and_no_others():
    wires = scene(6, frames=6)
    missing = {(2, 4), (4, 0), (4, 1), (4, 2)}
    dots = candidates(wires, 0, NOISE_MM, missing=missing)
    labels = label_by_calibration(dots, wires.phantom, truth(wires), wires.world_from_sensor)
    pairs = set(zip(labels.frame.tolist(), labels.wire.tolist(), strict=True))
    right = away_mm(labels, wires) < RIGHT_MM
    assert right.sum() == 6 * 9 - 4
    # Ringing under a wire stays within the gate of no other; a wrong dot may fall where a wire is missing.
    assert {pair for pair, r in zip(sorted(pairs), right, strict=True) if not r} <= missing
