import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.matching.matcher import FrameMatcher

PIXEL_MM = 0.05
CONVEX = ImageGrid.of_fan(193, 401, 0.08, 60.0, tuple(np.deg2rad((-25.0, 25.0))))
SECTOR = ImageGrid.of_fan(129, 401, 0.08, 0.0, tuple(np.deg2rad((-35.0, 35.0))), 12.0)


def speckle(grid):
    """A picture of speckle with room around the fan, and its margin, mm."""
    rng, margin = np.random.default_rng(0), 4.0
    size = np.ceil((grid.corners_mm[2, :2] - grid.corners_mm[0, :2] + 2 * margin) / PIXEL_MM).astype(int)
    parts = [gaussian_filter(rng.standard_normal(size), 0.3 / PIXEL_MM) for _ in range(2)]
    return sum(part**2 for part in parts), margin


def frame(grid, field, margin, motion):
    """Grey levels of the image moved in its plane over the picture."""
    at = grid.mm(*np.indices((grid.vectors, grid.samples))) - grid.centre_mm[:2]
    x_mm, y_mm, roll_rad = motion
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    x = c * at[..., 0] - s * at[..., 1] + x_mm + grid.centre_mm[0] + margin
    y = s * at[..., 0] + c * at[..., 1] + y_mm + grid.centre_mm[1] + margin
    intensity = np.maximum(map_coordinates(field, np.stack([x, y]) / PIXEL_MM, order=3), 1e-12)
    level = 255 + 255 / 60 * 10 * np.log10(intensity / field.max())
    return np.rint(np.clip(level, 0, 255)).astype(np.uint8)


@pytest.mark.parametrize("grid", [CONVEX, SECTOR], ids=["convex", "sector"])
@pytest.mark.parametrize("motion", [(0.3, 0.0, 0.0), (0.0, 0.25, 0.0), (-0.4, 0.2, 0.008)])
def test_motion_in_the_plane_of_a_fan(grid, motion):
    field, margin = speckle(grid)
    frames = np.stack([frame(grid, field, margin, m) for m in (np.zeros(3), motion)])
    sweep = Sweep(frames, grid, BModeSettings(60.0), np.arange(2.0))
    matcher = FrameMatcher(sweep)
    first, second = (matcher.ready(f).frame for f in frames)
    match = matcher.match({0: first}, 1, second, [matcher.search(first, second)])
    # The same field is seen again: within a fifth of a sample, and no elevational motion to read.
    np.testing.assert_allclose(match.inplane[0, :2], motion[:2], atol=0.016)
    assert match.inplane[0, 2] == pytest.approx(motion[2], abs=5e-4)
    assert np.nanmedian(match.correlation) > 0.97
