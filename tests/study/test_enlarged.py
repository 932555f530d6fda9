"""Cuts enlarged: where structures stand out, one scale for all, names above them, and nothing seen at all."""

import numpy as np
import pytest

from speckle3d.study.reslices.enlarged import DEEP_MM, busiest_rows, save_enlarged

PIXEL_MM = 0.1


def cut(rows=400, columns=120, layer=250, seed=0):
    """Speckle with a bright layer that reaches along the sweep."""
    image = np.random.default_rng(seed).normal(30.0, 3.0, (rows, columns)).astype(np.float32)
    image[layer : layer + 8, 20:90] += 20.0
    return image


def test_the_part_that_is_shown_holds_the_structure():
    deep = round(DEEP_MM / PIXEL_MM)
    first = busiest_rows(cut(), deep)
    assert first <= 250 <= first + deep - 8


@pytest.mark.parametrize("image", [cut(), np.full((400, 120), np.nan, np.float32), cut(rows=60)[:60]])
def test_every_cut_becomes_a_picture(image, tmp_path):
    path = save_enlarged({"tracker": image, "image": image}, PIXEL_MM, "a sweep", tmp_path / "e.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_cut_without_the_first_ones_width_is_shown_as_wide_as_the_narrowest(tmp_path):
    wide, narrow = cut(columns=150), cut(columns=90)
    assert save_enlarged({"tracker": wide, "image": narrow}, PIXEL_MM, "s", tmp_path / "e.png").exists()
