"""Simulated frames: determinism, statistics, invariance."""

import numpy as np
import pytest
from points import PointMedium
from scipy.signal import hilbert
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.simulation.beam import tabulate_beam
from speckle3d.simulation.medium import fully_developed, tissue
from speckle3d.simulation.scan import SimulatedFrames

STILL = RigidTransform.from_matrix(np.eye(4)[None])


@pytest.fixture(scope="module")
def beam():
    return tabulate_beam(attenuation_db_cm_mhz=0.3)


def image(vectors, beam, samples=3818):
    return ImageGrid(vectors, samples, 0.3, beam.probe.signal.sample_spacing_mm)


def test_uniform_speckle_is_fully_developed_at_every_depth(beam):
    frames = SimulatedFrames(beam, fully_developed(7), STILL, image(48, beam), snr_db=60.0)
    rf = frames[0].astype(float)
    intensity = np.abs(hilbert(rf, axis=-1)) ** 2
    for depth_mm in (5, 10, 20, 30, 40):
        row = round(depth_mm / frames.image.sample_spacing_mm)
        patch = intensity[:, row - 250 : row + 250]
        # About 14.4 mm x 5.8 mm / (0.5 mm x 0.12 mm) = 1400 cells. Variance of the contrast of exponential
        # intensity is 1 / cells (delta method): standard error 0.027; three of them.
        assert patch.std() / patch.mean() == pytest.approx(1.0, abs=0.08)
        # Mean intensity: standard error 0.027 likewise; the amplitude is its root.
        assert rf[:, row - 250 : row + 250].std() == pytest.approx(350.0, rel=0.06)


def test_a_frame_is_the_same_however_often_and_in_whatever_order_it_is_read(beam):
    poses = RigidTransform.from_translation([[0, 0, 0.0], [0, 0, 5.0], [0, 0, 0.4]])
    first, second = (
        SimulatedFrames(beam, tissue(3, 20.0), poses, image(6, beam), noise_entropy=4) for _ in range(2)
    )
    forward, backward = [first[i] for i in range(3)], [second[i] for i in (2, 1, 0)][::-1]
    np.testing.assert_array_equal(forward, backward)
    np.testing.assert_array_equal(first[-1], forward[2])
    assert not np.array_equal(forward[0], forward[1])


def test_electronic_noise_is_as_far_below_speckle_as_asked_at_the_focus_and_grows_with_gain(beam):
    medium = PointMedium(np.array([[0.0, 20.0, 0.0]]), np.zeros(1, np.float32))
    noise = SimulatedFrames(beam, medium, STILL, image(32, beam), snr_db=30.0)[0].astype(float)
    at = {d: round(d / beam.probe.signal.sample_spacing_mm) for d in (20, 38)}
    level = {d: noise[:, row - 100 : row + 100].std() for d, row in at.items()}
    # 6400 samples, a third of them independent: 1.5 % standard error, and the gain's slope.
    assert level[20] == pytest.approx(350.0 * 10**-1.5, rel=0.06)
    assert level[38] > 2.0 * level[20]
