"""Pictures of cuts: one scale, true axes, what sets modes apart, and where the picture's points lie."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.curved import curved_sheet
from speckle3d.imaging.planes import ReslicePlane
from speckle3d.study.cut_geometry import read_cuts, read_plane
from speckle3d.study.cuts import CutPicture, DrawnCut
from speckle3d.study.reslice_figures import draw_cuts, save_reslices

PLACED = RigidTransform.from_components([3.0, -40.0, 12.0], Rotation.from_euler("ZYX", [0.4, -0.7, 1.0]))


def plane_at(placed=PLACED, width_mm=15.0, height_mm=20.0):
    return ReslicePlane(placed, width_mm, height_mm, 0.5, (-1.0, 2.5))


def frames_across(x_mm):
    """Lines of frames that cross a plane at some places along it, from top to bottom."""
    x = np.asarray(x_mm, dtype=float)
    return np.stack([np.column_stack([x, np.full(x.size, y)]) for y in (2.5, 22.5)], axis=1)


def picture_of(modes, **words):
    rng = np.random.default_rng(9)
    cuts = {}
    for mode, stretch in modes.items():
        plane = plane_at()
        image = rng.normal(-20, 5, plane.shape).astype(np.float32)
        image[:, :3] = np.nan
        cuts[mode] = DrawnCut(image, plane, frames_across(stretch * np.linspace(0, 12, 25)))
    return CutPicture(cuts, name="s5", place="at lateral 3 mm", **words)


def test_cuts_share_one_scale_and_their_axes_are_true():
    picture = picture_of({"image": 1.06, "pose": 1.0}, reference="pose", levels=(-50.0, 0.0))
    figure, panels = draw_cuts(picture)
    assert "s5" in figure.get_suptitle()
    drawn = [panels[mode][0].images[0] for mode in ("image", "pose")]
    assert [each.get_clim() for each in drawn] == [(-50.0, 0.0)] * 2
    # Half a pixel of 0.5 mm around the first and the last centre.
    assert [tuple(each.get_extent()) for each in drawn] == [(-1.25, 14.25, 22.75, 2.25)] * 2


def test_points_picked_in_a_picture_are_points_of_the_world(tmp_path):
    picture = picture_of({"image": 1.06, "pose": 1.0}, reference="pose")
    # One bright pixel, to be found again in the picture.
    for drawn in picture.cuts.values():
        drawn.image[:] = -50
        drawn.image[31, 12] = 0.0
    path = save_reslices(picture, tmp_path / "cut.png")
    found = read_plane(path, "pose")
    left, top, right, bottom = found.boxes_px[0]
    pixels = np.asarray(Image.open(path).convert("L"), dtype=float)
    rows, columns = np.indices(pixels.shape) + 0.5
    width, height = (right - left) / 31, (bottom - top) / 41
    near = (np.abs(columns - left - 12.5 * width) < 0.7 * width) & (
        np.abs(rows - top - 31.5 * height) < 0.7 * height
    )
    bright = near & (pixels > 200)
    centre_px = columns[bright].mean(), rows[bright].mean()
    (mm,) = found.mm_from_px([centre_px])
    # A pixel of the picture is a tenth of one of the cut, which is 0.5 mm.
    np.testing.assert_allclose(mm, [-1.0 + 12 * 0.5, 2.5 + 31 * 0.5], atol=0.06)
    expected = PLACED.apply([12 * 0.5, 31 * 0.5, 0.0])
    np.testing.assert_allclose(found.cut.world_from_mm(*mm), expected, atol=0.1)


def test_the_geometry_of_planes_and_sheets_comes_back_from_the_file(tmp_path):
    sheet = curved_sheet([[0, 0, 0], [5, 0, 0], [5, 7, 0]], [0, 0, 2.0], (-1.0, 4.0), 0.5, smooth=False)
    for cut in (plane_at(), sheet):
        image = np.zeros(cut.shape, np.float32)
        path = save_reslices(CutPicture({"truth": DrawnCut(image, cut)}), tmp_path / "cut.png")
        (found,) = read_cuts(path)
        x, y = np.meshgrid([0.3, 2.0, 6.0], [3.0, 3.5])
        np.testing.assert_allclose(found.cut.world_from_mm(x, y), cut.world_from_mm(x, y), atol=1e-9)
        assert (found.mode, found.cut.shape) == ("truth", cut.shape)


def test_a_picture_without_a_finite_value_or_of_another_kind_is_refused(tmp_path):
    empty = DrawnCut(np.full(plane_at().shape, np.nan, np.float32), plane_at())
    with pytest.raises(InvalidInputError, match=r"pose.*finite"):
        draw_cuts(CutPicture({"pose": empty}))
    Image.new("L", (3, 3)).save(tmp_path / "other.png")
    (tmp_path / "text.png").write_text("no picture")
    for name in ("other.png", "text.png"):
        with pytest.raises(InvalidInputError, match=f"{name}: expected a PNG"):
            read_cuts(tmp_path / name)
