"""Claimed errors of a calibration from two sweeps, and answers that are refused by them."""

import dataclasses

import numpy as np
import pytest
from crossing_scenes import crossing_sweeps
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.errors import (
    DEEP_MM,
)
from calibration.images.similarity import prepare
from calibration.images.solver import calibrate_images
from calibration.settings import ImageFit
from speckle3d.core.streams import TimedPoses


@pytest.fixture(scope="module")
def scene():
    return crossing_sweeps(3, frames=24)


@pytest.fixture(scope="module")
def crossing(scene):
    return prepare(*scene[:2])


@pytest.mark.slow
def test_a_tracker_that_displaces_a_sweep_is_within_the_claims(scene, crossing):
    first, second, truth = scene
    nudge = RigidTransform.from_components([0.3, -0.3, 0.3], Rotation.from_rotvec([0.003, 0.0, 0.003]))
    centre = second.world_from_sensor(np.arange(24)) * truth
    about = RigidTransform.from_translation(centre.apply(first.grid.centre_mm).mean(axis=0))
    poses = about * nudge * about.inv() * second.readings.world_from_sensor
    shifted_sweep = dataclasses.replace(second, readings=TimedPoses(second.readings.time_s, poses))
    settings = ImageFit(capture_mm=0.0, capture_deg=0.0, tracker_mm=0.3, tracker_deg=0.15)
    plain = calibrate_images(crossing, truth, settings)
    nudged = calibrate_images(prepare(first, shifted_sweep), truth, settings)
    off = plain.sensor_from_image.inv() * nudged.sensor_from_image
    turns, errors = off.rotation.as_rotvec(), np.sqrt(np.diag(nudged.covariance)[:3])
    shifts = off.apply(first.grid.centre_mm) - first.grid.centre_mm
    spread = np.sqrt(np.diag(nudged.covariance_of(first.grid.centre_mm)))
    # Displacements of one standard error each move the answer, and within two and a half of what is claimed.
    assert np.linalg.norm(shifts) > 0.15
    assert (np.abs(shifts) < 2.5 * spread).all()
    assert (np.abs(turns) < 2.5 * errors).all()
    # And claims without a word of it would be too small.
    no_tracker = settings.model_copy(update={"tracker_mm": 0.0, "tracker_deg": 0.0})
    silent = np.sqrt(
        np.diag(calibrate_images(crossing, truth, no_tracker).covariance_of(first.grid.centre_mm))
    )
    assert (silent[[0, 2]] < 0.5 * spread[[0, 2]]).all()
    assert silent[1] > DEEP_MM * crossing.unit
