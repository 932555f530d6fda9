import numpy as np
import oracles
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.similarity import Comparison
from calibration.images.stacks import Stack
from speckle3d.kernels.slicing import PatchGrid

PIXELS = np.array([0.5, 0.4, 0.2, 1.0])
CALIBRATION = RigidTransform.from_components([3.0, -20.0, 5.0], Rotation.from_rotvec([0.2, -0.4, 0.9]))
GAP_MM = 3.0


def stack(seed, turn_deg):
    """A few smooth random images, a millimetre apart, turned about the depth axis."""
    rng = np.random.default_rng(seed)
    images = gaussian_filter(rng.standard_normal((14, 24, 26)), (1.0, 2.0, 2.0)).astype(np.float32)
    place = np.column_stack([rng.normal(0, 0.2, (14, 2)) - [6.0, 0.0], np.arange(14) - 6.5])
    world_from_image = RigidTransform.from_rotation(
        Rotation.from_euler("y", turn_deg, degrees=True)
    ) * RigidTransform.from_components(place, Rotation.from_rotvec(rng.normal(0, 0.03, (14, 3))))
    return Stack(images, PIXELS, world_from_image * CALIBRATION.inv())


@pytest.fixture(scope="module")
def comparison():
    patches = [
        PatchGrid(np.array([[3, 2, 4], [7, 9, 11], [10, 5, 12]]), (6, 5), 2),
        PatchGrid(np.array([[6, 8, 6]]), (5, 5), 2),
    ]
    return Comparison((stack(1, 0.0), stack(2, 80.0)), tuple(patches), GAP_MM)


def expected(comparison, way):
    """Correlations as the definition says, point by point."""
    sample, source, patches = comparison.stacks[way], comparison.stacks[1 - way], comparison.patches[way]
    to_source = (source.world_from_sensor * CALIBRATION).inv().as_matrix()[:, :3]
    found = []
    for k, u0, v0 in patches.where:
        pose, pairs = sample.world_from_sensor[int(k)] * CALIBRATION, []
        for a, b in np.ndindex(*patches.sides):
            u, v = u0 + a * patches.stride, v0 + b * patches.stride
            point = pose.apply([PIXELS[2] + u * PIXELS[0], PIXELS[3] + v * PIXELS[1], 0.0])
            level = oracles.cut_at(point, source.images, to_source, PIXELS, GAP_MM)
            if level is not None:
                pairs.append((sample.images[k, u, v], level))
        share = len(pairs) / np.prod(patches.sides)
        found.append(np.corrcoef(np.array(pairs).T)[0, 1] if share >= comparison.least_share else np.nan)
    return np.array(found)


def test_correlations_are_those_of_the_definition(comparison):
    found = comparison.at(CALIBRATION).alike
    wanted = np.concatenate([expected(comparison, way) for way in (0, 1)])
    assert np.isfinite(wanted).sum() >= 3
    # Single precision of the images.
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.parametrize("parameter", [0, 2, 4])
def test_gradient_is_the_change_of_correlation(comparison, parameter):
    step = 2e-4

    def moved(amount):
        change = np.zeros(6)
        change[parameter] = amount
        turn = Rotation.from_rotvec(change[:3])
        at = CALIBRATION * RigidTransform.from_components(change[3:], turn)
        return comparison.at(at).alike

    gradient = comparison.at(CALIBRATION, derivatives=True).gradient[:, parameter]
    slope = (moved(step) - moved(-step)) / (2 * step)
    valid = np.isfinite(slope)
    assert valid.sum() >= 3
    # Interpolation is linear: where a point crosses a pixel's edge within the step, its slope changes.
    np.testing.assert_allclose(
        gradient[valid], slope[valid], rtol=0.05, atol=0.02 * np.abs(slope[valid]).max()
    )
