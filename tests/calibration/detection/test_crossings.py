"""Candidates for crossings: in simulated scans of wires, at beads, and not at edges."""

import numpy as np
from crossing_images import Look, Probe, crossing_world
from wire_scenes import PIXEL_MM, picture

from calibration.detection.crossings import crossings_in_frames

SMALL = Probe(
    (200, 260), np.array([0.3, 0.25]), np.array([100.0, 8.0]), 60.0, 48.0, np.inf, beams=120, samples=300
)
CLEAR = Look(
    elevation_mm=0.9,
    focus_mm=30.0,
    spread_mm=25.0,
    pulse_mm=0.3,
    beam_mm=0.6,
    lobes_db=-25.0,
    lobes_mm=12.0,
    slope_db=6.0,
    speckle_db=-32.0,
    noise_db=-45.0,
    range_db=50.0,
    gain_step_db=8.0,
    skin_db=8.0,
    skin_mm=6.0,
    points_per_cm3=2.0,
    points_db=0.0,
    tail=0.2,
    faint_db=-6.0,
    lettering=True,
    floor_db=-np.inf,
    floor_mm=20.0,
)


def offered(world, seen, near_mm=2.0):
    """Share of the frames that show the crossing in which a candidate is near it."""
    away = np.hypot(*((seen.pixels - world.crossing_px[seen.frame]) * world.pixel_mm).T)
    return np.isin(np.flatnonzero(world.shown), seen.frame[away < near_mm]).mean()


def test_crossings_are_among_the_candidates():
    world = crossing_world(3, 12, probe=SMALL, look=CLEAR)
    told = []
    seen = crossings_in_frames(
        world.images, world.pixel_mm, progress=lambda done, total: told.append((done, total))
    )
    assert world.shown.sum() >= 8
    # 92 % over all looks, of which this is a clear one.
    assert offered(world, seen) >= 0.85
    assert told[-1] == (12, 12)
    assert (np.diff(seen.frame) >= 0).all()


def test_a_bead_is_the_first_candidate_and_placed_to_a_tenth_of_a_millimetre():
    true = np.array([[200.0, 100.0], [90.0, 250.0]])
    seen = crossings_in_frames(np.stack([picture([one], seed=7, haze=0.05) for one in true]), PIXEL_MM)
    first = seen.pixels[[0, int(np.argmax(seen.frame == 1))]]
    across, down = ((first - true) * PIXEL_MM).T
    # Measured 0.02 mm; ringing under the bead draws it down by 0.1 mm, alike everywhere.
    assert (np.abs(across) < 0.1).all()
    assert (np.abs(down - 0.1) < 0.05).all()
