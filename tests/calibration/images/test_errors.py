"""Claimed errors of a calibration from two sweeps, and answers that are refused by them."""

import dataclasses

import numpy as np
import pytest
from crossing_scenes import crossing_sweeps, displaced
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import Angulation
from calibration.images.errors import (
    DEEP_MM,
    _left_out,
    require_known,
    require_one_answer,
)
from calibration.images.search import DECIDED
from calibration.images.similarity import Estimate, prepare
from calibration.images.solver import calibrate_from_sweeps
from calibration.settings import ImageFit
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses

CENTRE = np.array([15.0, 20.0, 0.0])


def test_leaving_out_blocks_gives_the_standard_error_of_a_mean():
    rng = np.random.default_rng(0)
    values = 3.0 * rng.standard_normal(400)
    # A mean as an answer: slopes are residuals and each value bends by one; four values make a block.
    slopes, bends = (values - values.mean())[:, None], np.ones((400, 1, 1))
    found = _left_out(slopes, bends, np.arange(400) // 4, np.array([[400.0]]))
    blocks = values.reshape(-1, 4).mean(axis=1)
    # The textbook's standard error of a mean of 100 blocks; leaving one out shares what is left, 1 / 99.
    assert found[0, 0] == pytest.approx(blocks.var(ddof=1) / 100.0, rel=0.03)


def test_an_answer_that_is_not_known_is_refused():
    certainty = np.diag([1e-5, 1e-5, 1e-5, 0.01, 1.2**2, 0.01, 0.0, 0.0])
    angulation = Angulation(90.0, (45.0, 45.0), (0.8, 0.8), np.ones(6), np.ones(6), 20.0)
    with pytest.raises(InsufficientDataError, match="y to 1 mm"):
        require_known(certainty, angulation, CENTRE)
    certainty[4, 4] = 0.01
    require_known(certainty, angulation, CENTRE)


@pytest.fixture(scope="module")
def scene():
    return crossing_sweeps(3, frames=24)


@pytest.fixture(scope="module")
def crossing(scene):
    return prepare(*scene[:2])


def test_another_answer_as_good_is_refused(scene, crossing):
    truth = scene[2]
    comparison = crossing.level(DECIDED, truth)
    here = Estimate(truth, np.ones(2))
    beside = Estimate(displaced(truth, np.random.default_rng(1), 8.0, 8.0), np.ones(2))
    # The truth is not in doubt for a place far from it; that place is, for the truth.
    require_one_answer(comparison, here, [beside], crossing.centre_mm)
    with pytest.raises(InsufficientDataError, match="fits as well"):
        require_one_answer(comparison, beside, [here], crossing.centre_mm)


@pytest.mark.slow
def test_a_tracker_that_displaces_a_sweep_is_within_the_claims(scene, crossing):
    first, second, truth = scene
    nudge = RigidTransform.from_components([0.3, -0.3, 0.3], Rotation.from_rotvec([0.003, 0.0, 0.003]))
    centre = second.world_from_sensor(np.arange(24)) * truth
    about = RigidTransform.from_translation(centre.apply(first.grid.centre_mm).mean(axis=0))
    poses = about * nudge * about.inv() * second.readings.world_from_sensor
    moved = dataclasses.replace(second, readings=TimedPoses(second.readings.time_s, poses))
    settings = ImageFit(capture_mm=0.0, capture_deg=0.0, tracker_mm=0.3, tracker_deg=0.15)
    plain = calibrate_from_sweeps(crossing, truth, settings)
    found = calibrate_from_sweeps(prepare(first, moved), truth, settings)
    off = plain.sensor_from_image.inv() * found.sensor_from_image
    turns, errors = off.rotation.as_rotvec(), np.sqrt(np.diag(found.covariance)[:3])
    shifts = off.apply(first.grid.centre_mm) - first.grid.centre_mm
    spread = np.sqrt(np.diag(found.covariance_of(first.grid.centre_mm)))
    # Displacements of one standard error each move the answer, and within two and a half of what is claimed.
    assert np.linalg.norm(shifts) > 0.15
    assert (np.abs(shifts) < 2.5 * spread).all()
    assert (np.abs(turns) < 2.5 * errors).all()
    # And claims without a word of it would be too small.
    told = settings.model_copy(update={"tracker_mm": 0.0, "tracker_deg": 0.0})
    silent = np.sqrt(
        np.diag(calibrate_from_sweeps(crossing, truth, told).covariance_of(first.grid.centre_mm))
    )
    assert (silent[[0, 2]] < 0.5 * spread[[0, 2]]).all()
    assert silent[1] > DEEP_MM * crossing.unit
