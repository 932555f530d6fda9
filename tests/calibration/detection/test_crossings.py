"""Candidates for crossings: in simulated scans of wires, at beads, and not at edges."""

import numpy as np
from crossing_images import crossing_world
from wire_scenes import PIXEL_MM, picture

from calibration.detection.crossings import crossings_in_frames


def test_crossings_are_among_the_candidates():
    world, progress = crossing_world(603, 14), []
    candidates = crossings_in_frames(
        world.images, world.pixel_mm, progress=lambda done, total: progress.append((done, total))
    )
    frames = np.flatnonzero(world.is_visible)
    away = (candidates.pixels - world.crossing_px[candidates.frame]) * world.pixel_mm
    assert len(frames) >= 8
    # 86 % over all looks.
    assert np.isin(frames, candidates.frame[np.hypot(*away.T) < 2.0]).mean() >= 0.75
    assert progress[-1] == (14, 14)


def test_a_bead_is_the_first_candidate_and_placed_to_a_tenth_of_a_millimetre():
    true = np.array([[200.0, 100.0], [90.0, 250.0]])
    candidates = crossings_in_frames(
        np.stack([picture([bead], seed=7, haze=0.05) for bead in true]), PIXEL_MM
    )
    first = candidates.pixels[[0, int(np.argmax(candidates.frame == 1))]]
    across, down = ((first - true) * PIXEL_MM).T
    # Measured 0.02 mm; ringing under the bead draws it down by 0.1 mm, alike everywhere.
    assert (np.abs(across) < 0.1).all()
    assert (np.abs(down - 0.1) < 0.05).all()
