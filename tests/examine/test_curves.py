"""Curves that do not belong to a sweep are told from those that do."""

from dataclasses import replace

import numpy as np
import pytest
import speckle

from speckle3d.core.curves import SpeckleSize
from speckle3d.core.grid import ImageGrid
from speckle3d.examine.curves import doubt_bend, doubt_size, doubt_width
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.coherence import RowScales

PATCHES = lay_patches(ImageGrid(vectors=48, samples=500, vector_pitch_mm=0.3, sample_spacing_mm=0.06))
ROWS = PATCHES.row_depth_mm
SIZE = SpeckleSize(np.linspace(0.3, 0.4, ROWS.size), np.linspace(0.07, 0.08, ROWS.size))
CURVES = replace(speckle.curves(depth_mm=tuple(ROWS)), speckle=SIZE)
CLEAR = np.ones(ROWS.size)


@pytest.mark.parametrize(("factor", "refutes"), [(1.0, False), (5.0, False), (1000.0, True)])
def test_curves_wider_than_any_beam_are_refuted(factor, refutes):
    doubt = doubt_width(replace(CURVES, distance_mm=factor * CURVES.distance_mm))
    assert (doubt is not None and doubt.refuted) == refutes


def row_scales(by, gain=1.0):
    """Scales that rise by so much from the first row to the middle."""
    line = by * np.linspace(-1, 1, 9)
    return RowScales(np.linspace(3, 30, 9), line, np.full(9, gain))


@pytest.mark.parametrize(
    ("rows", "refutes"),
    [
        (row_scales(0.08), None),
        (row_scales(0.25), False),
        (row_scales(0.6), True),
        (row_scales(0.6, gain=0.5), None),
        (None, None),
    ],
    ids=["right", "doubtful", "reversed", "noisy", "not adapted to"],
)
def test_depths_that_disagree_doubt_the_curves(rows, refutes):
    doubt = doubt_bend(rows)
    assert (doubt and doubt.refuted) == refutes


def speckle_size(lateral=1.0, axial=1.0):
    return SpeckleSize(SIZE.lateral_mm * lateral, SIZE.axial_mm * axial)


@pytest.mark.parametrize(
    ("image_speckle", "refutals"),
    [
        (speckle_size(), []),
        (speckle_size(1.1, 1.2), []),
        (speckle_size(0.9, 0.8), []),
        (speckle_size(1.16), [False]),
        (speckle_size(0.7), [True]),
        (speckle_size(axial=0.5), [True]),
        (speckle_size(1.4, 2.0), [True, True]),
    ],
)
def test_speckle_of_another_size_doubts_the_curves(image_speckle, refutals):
    assert [d.refuted for d in doubt_size(image_speckle, CURVES, PATCHES, CLEAR)] == refutals


def test_rows_of_noise_say_nothing_of_the_size_of_speckle():
    assert doubt_size(speckle_size(0.7, 0.5), CURVES, PATCHES, 0.5 * CLEAR) == ()
