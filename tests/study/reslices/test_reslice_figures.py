"""Pictures of cuts: one scale, true axes, what sets modes apart, and where the picture's points lie."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.curved import curved_sheet
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.study.reslices.cut_geometry import read_cuts, read_plane
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut
from speckle3d.study.reslices.reslice_figures import draw_cuts, save_reslices

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
        x = stretch * np.linspace(0, 12, 25)
        cuts[mode] = DrawnCut(image, plane, frames_across(x), x)
    return CutPicture(cuts, name="s5", place="at lateral 3 mm", **words)


def test_cuts_share_one_scale_and_their_axes_are_true():
    picture = picture_of({"image": 1.06, "pose": 1.0}, reference="pose", levels=(-50.0, 0.0))
    figure, panels = draw_cuts(picture)
    assert "s5" in figure.get_suptitle()
    drawn = [panels[mode][0].images[0] for mode in ("image", "pose")]
    assert [each.get_clim() for each in drawn] == [(-50.0, 0.0)] * 2
    # Half a pixel of 0.5 mm around the first and the last centre.
    assert [tuple(each.get_extent()) for each in drawn] == [(-1.25, 14.25, 22.75, 2.25)] * 2


def words_of(figure):
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_a_mode_that_is_too_long_is_told_and_shown_so():
    figure, panels = draw_cuts(picture_of({"truth": 1.0, "image": 1.06, "pose": 0.99}, reference="truth"))
    words = words_of(figure)
    assert {"12.72 mm  +6.0 %", "11.88 mm  -1.0 %", "12.00 mm"} <= set(words)
    # Laid over the reference: magenta is this mode's, green the reference's, grey where both are alike.
    assert [len(panels[mode]) for mode in ("image", "pose", "truth")] == [2, 2, 1]
    # The first three columns show nothing.
    colours = np.asarray(panels["image"][1].images[0].get_array())[:, 3:]
    red, green, blue = np.moveaxis(colours, -1, 0)
    np.testing.assert_array_equal(red, blue)
    assert np.corrcoef(red.ravel(), green.ravel())[0, 1] < 0.2
    alone = draw_cuts(picture_of({"image": 1.0}))[0]
    assert "12.00 mm" in words_of(alone)


def test_frames_go_by_their_own_numbers():
    numbers = np.arange(25) * 3 + 100
    figure, _ = draw_cuts(picture_of({"image": 1.0}, numbers=numbers))
    shown = {text for text in words_of(figure) if text.isdecimal()}
    assert {"100", "172"} <= shown <= {str(number) for number in numbers}


@pytest.mark.parametrize("modes", [2, 7])
@pytest.mark.parametrize("size_mm", [(300.0, 20.0), (12.0, 45.0), (0.5, 0.5)])
def test_panels_do_not_overlap_and_keep_their_proportions(modes, size_mm):
    plane = ReslicePlane(PLACED, *size_mm, size_mm[0] / 20)
    image = np.arange(np.prod(plane.shape), dtype=np.float32).reshape(plane.shape)
    names = ["image", "orientation", "pose", "crossed", "inertial", "fused", "truth"][:modes]
    cuts = {name: DrawnCut(image, plane) for name in names}
    figure, panels = draw_cuts(CutPicture(cuts, reference=names[-1] if modes > 1 else None))
    boxes = [axes.get_position() for row in panels.values() for axes in row]
    assert all(box.x0 >= 0 and box.x1 <= 1 and box.y0 >= 0 and box.y1 <= 1 for box in boxes)
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            apart = one.x0 >= other.x1 or other.x0 >= one.x1 or one.y0 >= other.y1 or other.y0 >= one.y1
            assert apart
    assert figure.get_figwidth() < 14
    assert figure.get_figheight() < 14


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
