"""Pictures of cuts: one scale, true axes, how long each mode is, and where the picture's points lie."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.curved import curved_sheet
from speckle3d.imaging.cuts.planes import plane_cut
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, length_words, read_plane
from speckle3d.study.reslices.reslice_figures import draw_cuts, save_reslices

WORLD_FROM_PLANE = RigidTransform.from_components(
    [3.0, -40.0, 12.0], Rotation.from_euler("ZYX", [0.4, -0.7, 1.0])
)
PLANE = plane_cut(WORLD_FROM_PLANE, (-1.0, 2.5), (14.0, 22.5), 0.5)


def picture_of(modes, **words):
    rng, x = np.random.default_rng(9), np.linspace(0, 12, 25)
    lines = np.stack([np.column_stack([x, np.full(x.size, y)]) for y in (2.5, 22.5)], axis=1)
    images = [rng.normal(-20, 5, PLANE.shape).astype(np.float32) for _ in modes]
    cuts = {mode: DrawnCut(image, PLANE, lines) for mode, image in zip(modes, images, strict=True)}
    return CutPicture(cuts, name="s5", place="at lateral 3 mm", **words)


def test_cuts_share_one_scale_true_axes_and_the_lengths_of_the_table():
    rows = [ModeError("f", "image", 25, 11.73, 11.914, 0.18, 1.57, 0.0, 0.0, 0.0)]
    words = length_words(rows, "truth")
    assert words == {"image": "11.91 mm +1.6 %", "truth": "11.73 mm"}
    panels = draw_cuts(picture_of(["image", "truth"], lengths=words)).axes[:2]
    images = [panel.images[0] for panel in panels]
    assert [image.get_clim() for image in images] == [(-50.0, 0.0)] * 2
    # Half a pixel of 0.5 mm around the first and the last centre.
    assert [tuple(image.get_extent()) for image in images] == [(-1.25, 14.25, 22.75, 2.25)] * 2
    titles = [panel.get_title() for panel in panels]
    assert titles == [f"{mode}\n{length}" for mode, length in words.items()]


def test_many_cuts_stand_in_rows_that_show_them_large():
    figure = draw_cuts(picture_of("abcdefg"), (-1.0, 12.0, 14.5, 2.5))
    figure.draw_without_rendering()
    widths = [axes.get_position().width * figure.get_figwidth() for axes in figure.axes[:7]]
    # In one row of 11 inches each had 1.6.
    assert min(widths) > 2.2


def test_lengths_over_narrow_cuts_do_not_overlap():
    lengths = dict.fromkeys("abc", "13.58 mm +14.6 %\n13.00 mm -11.5 %")
    figure = draw_cuts(picture_of("abc", lengths=lengths), (-1.0, 1.0, 44.0, 0.0))
    figure.draw_without_rendering()
    spans = [axes.title.get_window_extent() for axes in figure.axes[:3]]
    assert all(a.x1 < b.x0 for a, b in pairwise(spans))


def test_where_a_plane_lies_comes_back_from_the_file(tmp_path):
    sheet = curved_sheet(np.eye(3), np.array([0, 0, 1.0]), (-1.0, 4.0), 0.5)
    cuts = {"truth": sheet, "pose": PLANE}
    panels = {mode: DrawnCut(np.zeros(cut.shape, np.float32), cut, np.empty(0)) for mode, cut in cuts.items()}
    path = save_reslices(CutPicture(panels, marks={"pose": "a mark"}), tmp_path / "cut.png")
    plane = read_plane(path)
    assert (plane.mode, plane.mark) == ("pose", "a mark")
    picks = np.array([[-1.0, 2.5], [2.0, 3.5]])
    np.testing.assert_allclose(
        plane.world_mm(picks), WORLD_FROM_PLANE.apply(np.insert(picks, 2, 0, axis=1)), atol=1e-9
    )
    with pytest.raises(InvalidInputError):
        read_plane(path, "truth")
    path.write_bytes(b"no picture")
    with pytest.raises(InvalidInputError, match="speckle3d reslice"):
        read_plane(path)
