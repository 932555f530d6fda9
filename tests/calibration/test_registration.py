"""How much of a phantom's stated place is believed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from wire_scenes import PIXEL_MM, scene

from calibration.points import Detections
from calibration.wires import calibrate_wires

CORNERS = np.array([[0.0, 0.0, 0.0], [70.0, 0.0, 0.0], [0.0, 48.0, 0.0], [70.0, 48.0, 0.0]])


def recording(seed, frames=48):
    """Dots known to 0.1 mm and poses to 0.1 mm and 0.05 degrees."""
    wires = scene(seed, frames=frames, degrees=20.0)
    rng = np.random.default_rng([seed, 1])
    count = wires.pixels.shape[1]
    pixels = wires.pixels + 0.1 * rng.standard_normal(wires.pixels.shape) / PIXEL_MM
    place, turn = wires.world_from_sensor.as_components()
    jitter = Rotation.from_rotvec(np.deg2rad(0.05) * rng.standard_normal((frames, 3)))
    poses = RigidTransform.from_components(place + 0.1 * rng.standard_normal(place.shape), turn * jitter)
    frame = np.repeat(np.arange(frames), count)
    dots = Detections(frame, pixels.reshape(-1, 2), np.tile(np.arange(count), frames))
    return wires, dots.points(poses[frame], frame / 10.0)


def with_wrong_place(wires, shift_mm, turn_deg):
    """The phantom with a place that is wrong, about its middle."""
    middle = RigidTransform.from_translation([45.0, 20.0, 10.0])
    wrong = RigidTransform.from_components(
        shift_mm * np.array([0.6, 0.0, 0.8]),
        Rotation.from_rotvec(np.deg2rad(turn_deg) * np.array([0.6, 0.8, 0.0])),
    )
    place = wires.phantom.world_from_phantom * middle * wrong * middle.inv()
    return replace(wires.phantom, world_from_phantom=place)


def corners_off_mm(solution, wires):
    step = wires.sensor_from_image.inv() * solution.chain.sensor_from_image
    return float(np.linalg.norm(step.apply(CORNERS) - CORNERS, axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shift_mm", "turn_deg", "is_believed"), [(0.0, 0.0, True), (0.0, 2.5, True), (3.0, 2.5, False)]
)
def test_a_stated_place_counts_unless_the_dots_contradict_it(shift_mm, turn_deg, is_believed):
    wires, points = recording(4)
    solution = calibrate_wires(points, with_wrong_place(wires, shift_mm, turn_deg), PIXEL_MM)
    assert ("counts as known" in solution.adequacy.verdict) == is_believed
    # Dots of 0.1 mm in 48 frames; with the place held, its own error of 3 mm or 2.5 degrees would remain.
    assert corners_off_mm(solution, wires) < 0.8
