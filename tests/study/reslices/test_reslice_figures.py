"""Pictures of cuts: one scale, true axes, how long each mode is, and where the picture's points lie."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.curved import curved_sheet
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.reslices.cut_geometry import read_cuts, read_plane
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, length_words
from speckle3d.study.reslices.reslice_figures import busiest_rows, draw_cuts, save_reslices

PLACED = RigidTransform.from_components([3.0, -40.0, 12.0], Rotation.from_euler("ZYX", [0.4, -0.7, 1.0]))


def plane_at(placed=PLACED, width_mm=15.0, height_mm=20.0):
    return ReslicePlane(placed, width_mm, height_mm, 0.5, (-1.0, 2.5))


def picture_of(modes, **words):
    rng = np.random.default_rng(9)
    cuts = {}
    for mode, stretch in modes.items():
        image = rng.normal(-20, 5, plane_at().shape).astype(np.float32)
        x = stretch * np.linspace(0, 12, 25)
        lines = np.stack([np.column_stack([x, np.full(x.size, y)]) for y in (2.5, 22.5)], axis=1)
        cuts[mode] = DrawnCut(image, plane_at(), lines, x)
    return CutPicture(cuts, name="s5", place="at lateral 3 mm", **words)


def test_cuts_share_one_scale_below_the_maximum_and_their_axes_are_true():
    figure, panels = draw_cuts(picture_of({"image": 1.06, "pose": 1.0}))
    assert "s5" in figure.get_suptitle()
    drawn = [panels[mode].images[0] for mode in ("image", "pose")]
    assert [each.get_clim() for each in drawn] == [(-50.0, 0.0)] * 2
    # Half a pixel of 0.5 mm around the first and the last centre.
    assert [tuple(each.get_extent()) for each in drawn] == [(-1.25, 14.25, 22.75, 2.25)] * 2


def test_lengths_beside_the_rows_are_those_of_the_table_and_frames_have_their_numbers():
    rows = [ModeError("f", "image", 25, 11.73, 11.914, 0.18, 1.57, 0.0, 0.0, 0.0)]
    numbers = np.arange(25) * 3 + 100
    words = length_words(rows, "truth")
    assert words == {"image": "11.91 mm +1.6 %", "truth": "11.73 mm"}
    figure, _ = draw_cuts(picture_of({"image": 1.0, "truth": 1.0}, numbers=numbers, lengths=words))
    texts = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert set(words.values()) <= texts
    assert {"100", "172"} <= {text for text in texts if text.isdecimal()} <= {str(n) for n in numbers}


@pytest.mark.parametrize("modes", [2, 7])
@pytest.mark.parametrize("size_mm", [(300.0, 20.0), (12.0, 45.0), (0.5, 0.5)])
def test_panels_do_not_overlap(modes, size_mm):
    plane = ReslicePlane(PLACED, *size_mm, size_mm[0] / 20)
    image = -np.arange(np.prod(plane.shape), dtype=np.float32).reshape(plane.shape)
    names = ["image", "orientation", "pose", "crossed", "tracker", "fused", "truth"][:modes]
    figure, panels = draw_cuts(CutPicture({name: DrawnCut(image, plane) for name in names}))
    figure.draw_without_rendering()
    boxes = [axes.get_tightbbox() for axes in panels.values()]
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            assert one.x0 >= other.x1 or other.x0 >= one.x1 or one.y0 >= other.y1 or other.y0 >= one.y1
    assert max(figure.get_size_inches()) < 19


def test_points_picked_in_a_picture_are_points_of_the_world(tmp_path):
    picture = picture_of({"image": 1.06, "pose": 1.0})
    # One bright pixel, to be found again in the picture.
    for drawn in picture.cuts.values():
        drawn.image[:] = -50
        drawn.image[31, 12] = 0.0
    path = save_reslices(picture, tmp_path / "cut.png")
    shown = read_plane(path, "pose")
    left, top, right, bottom = shown.boxes_px[0]
    pixels = np.asarray(Image.open(path).convert("L"), dtype=float)
    rows, columns = np.indices(pixels.shape) + 0.5
    width, height = (right - left) / 31, (bottom - top) / 41
    near = (np.abs(columns - left - 12.5 * width) < 0.7 * width) & (
        np.abs(rows - top - 31.5 * height) < 0.7 * height
    )
    bright = near & (pixels > 200)
    (mm,) = shown.mm_from_px([(columns[bright].mean(), rows[bright].mean())])
    # A pixel of the picture is a tenth of one of the cut, which is 0.5 mm.
    np.testing.assert_allclose(mm, [-1.0 + 12 * 0.5, 2.5 + 31 * 0.5], atol=0.06)
    np.testing.assert_allclose(
        shown.cut.world_from_mm(*mm), PLACED.apply([12 * 0.5, 31 * 0.5, 0.0]), atol=0.1
    )


def test_the_geometry_of_planes_and_sheets_comes_back_from_the_file(tmp_path):
    sheet = curved_sheet([[0, 0, 0], [5, 0, 0], [5, 7, 0]], [0, 0, 2.0], (-1.0, 4.0), 0.5, smooth=False)
    for cut in (plane_at(), sheet):
        image = np.zeros(cut.shape, np.float32)
        path = save_reslices(CutPicture({"truth": DrawnCut(image, cut)}), tmp_path / "cut.png")
        (shown,) = read_cuts(path)
        x, y = np.meshgrid([0.3, 2.0, 6.0], [3.0, 3.5])
        np.testing.assert_allclose(shown.cut.world_from_mm(x, y), cut.world_from_mm(x, y), atol=1e-9)
        assert (shown.mode, shown.cut.shape) == ("truth", cut.shape)


def test_a_picture_without_a_finite_value_or_of_another_kind_is_refused(tmp_path):
    empty = DrawnCut(np.full(plane_at().shape, np.nan, np.float32), plane_at())
    with pytest.raises(InvalidInputError, match=r"pose.*finite"):
        draw_cuts(CutPicture({"pose": empty}))
    Image.new("L", (3, 3)).save(tmp_path / "other.png")
    (tmp_path / "text.png").write_text("no picture")
    for name in ("other.png", "text.png"):
        with pytest.raises(InvalidInputError, match=f"{name}: expected a PNG"):
            read_cuts(tmp_path / name)


def test_the_enlarged_part_is_where_structures_run_along_the_sweep():
    image = np.random.default_rng(1).normal(0.0, 5.0, (300, 80)).astype(np.float32)
    image[200:230, 20:60] += 12.0
    assert 120 <= busiest_rows(image, 110) <= 200
    assert busiest_rows(np.full((300, 80), np.nan, np.float32), 110) == 0
