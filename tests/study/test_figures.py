import subprocess
import sys

import numpy as np
import pytest
from drifting import CENTRE_MM, drifted, hand_sweep, tracked

from speckle3d.core.errors import FileError, InvalidInputError, MismatchError
from speckle3d.scoring.lengths import accumulated
from speckle3d.study.figures import MODE_COLOURS, figure_drift, figure_reslice, save_figure, wrapped


@pytest.fixture(scope="module")
def sweep():
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, 60)
    return drifted(truth, rng), tracked(truth, rng)


def test_drift_figure_draws_every_mode_and_the_reference_in_both_panels(sweep):
    image, tracker = sweep
    figure = figure_drift({"image": image, "pose": image}, CENTRE_MM, tracker, reference_name="tracker")
    offset, tilt = figure.axes
    assert [line.get_label() for line in offset.lines] == ["tracker", "image-based", "six DOF correction"]
    motion = accumulated(image, CENTRE_MM)
    np.testing.assert_allclose(offset.lines[1].get_ydata(), motion.length_mm)
    np.testing.assert_allclose(tilt.lines[1].get_ydata(), np.rad2deg(motion.tilt_rad))
    assert offset.lines[1].get_color() == MODE_COLOURS["image"] == tilt.lines[1].get_color()


def test_the_images_95_percent_interval_is_drawn_in_both_panels(sweep):
    image, tracker = sweep
    deviation = np.linspace(0.0, 0.8, 60)
    covariance = np.zeros((60, 6, 6))
    # Along z, mm, and tilt, rad: the panels' own.
    covariance[:, 2, 2], covariance[:, 3, 3] = deviation**2, (0.01 * deviation) ** 2
    covariance[:, 0, 0] = 1e6
    drawn = {"image": image, "pose": image}
    plain, shaded = (figure_drift(drawn, CENTRE_MM, tracker, covariance=c) for c in (None, covariance))
    assert [len(panel.collections) for panel in plain.axes] == [0, 0]
    assert [len(panel.collections) for panel in shaded.axes] == [1, 1]
    motion = accumulated(image, CENTRE_MM)
    curves = (motion.length_mm, np.rad2deg(motion.tilt_rad))
    widths = (1.96 * deviation, np.rad2deg(1.96 * 0.01 * deviation))
    for panel, curve, width in zip(shaded.axes, curves, widths, strict=True):
        outline = panel.collections[0].get_paths()[0].vertices
        for frame in (0, 20, 59):
            at = outline[np.isclose(outline[:, 0], frame), 1]
            assert at.max() == pytest.approx(curve[frame] + width[frame], abs=1e-9)
            assert at.min() == pytest.approx(curve[frame] - width[frame], abs=1e-9)
    assert "95 % of image" in [text.get_text() for text in shaded.axes[0].get_legend().get_texts()]


def test_no_interval_is_drawn_without_the_images_curve(sweep):
    figure = figure_drift({"pose": sweep[0]}, CENTRE_MM, covariance=np.tile(np.eye(6), (60, 1, 1)))
    assert not figure.axes[0].collections


def test_reference_trace_has_gaps_and_does_not_hang_on_its_first_reading(sweep):
    image, tracker = sweep
    covered = np.ones(60, dtype=bool)
    covered[20:30] = False
    matrices = tracker.as_matrix()
    matrices[0, :3, 3] += 5.0
    spoilt = type(tracker).from_matrix(matrices)
    drawn, spoilt_drawn = (
        figure_drift({"image": image}, CENTRE_MM, each, covered).axes[0].lines[0].get_ydata()
        for each in (tracker, spoilt)
    )
    np.testing.assert_array_equal(np.isnan(drawn), ~covered)
    # One of nine readings that set the level is bad; their median moves by less than their jitter.
    assert np.nanmax(np.abs(spoilt_drawn - drawn)[1:]) < 0.2


def test_drift_figure_without_reference_and_with_one_of_another_length(sweep):
    image, tracker = sweep
    assert len(figure_drift({"image": image}, CENTRE_MM).axes[0].lines) == 1
    with pytest.raises(MismatchError, match="expected 60 poses for 60 frames, got 59"):
        figure_drift({"image": image}, CENTRE_MM, tracker[1:])


def test_reslices_share_one_scale_and_keep_their_extents():
    rng = np.random.default_rng(9)
    images = {"image": rng.normal(0, 5, (40, 30)), "pose": rng.normal(0, 5, (40, 20))}
    images["image"][:, :3] = np.nan
    extents = {"image": (0.0, 15.0, 20.0, 0.0), "pose": (0.0, 10.0, 20.0, 0.0)}
    figure = figure_reslice(images, extents, dynamic_range_db=40.0)
    drawn = [axes.images[0] for axes in figure.axes]
    assert drawn[0].get_clim() == drawn[1].get_clim()
    assert np.ptp(drawn[0].get_clim()) == pytest.approx(40.0)
    assert [tuple(d.get_extent()) for d in drawn] == list(extents.values())
    figure.canvas.draw()
    widths = [axes.get_position().width for axes in figure.axes]
    assert widths[0] / widths[1] == pytest.approx(1.5, rel=0.05)


def test_reslices_that_cannot_be_drawn_are_refused():
    with pytest.raises(InvalidInputError, match="at least one reslice"):
        figure_reslice({}, {})
    with pytest.raises(MismatchError, match=r"extents_mm: expected the modes \['image'\], got those of \[\]"):
        figure_reslice({"image": np.zeros((2, 2))}, {})
    with pytest.raises(InvalidInputError, match="a finite value in some reslice"):
        figure_reslice({"image": np.full((2, 2), np.nan)}, {"image": (0.0, 1.0, 1.0, 0.0)})


def test_a_png_of_150_dots_per_inch_appears_whole(sweep, tmp_path):
    path = save_figure(figure_drift({"image": sweep[0]}, CENTRE_MM), tmp_path / "new" / "drift.png")
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20], "big") == 1500
    assert [p.name for p in path.parent.iterdir()] == ["drift.png"]
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be made a folder"):
        save_figure(figure_drift({"image": sweep[0]}, CENTRE_MM), tmp_path / "file" / "drift.png")


def test_neither_pyplot_nor_a_window_system_is_touched():
    code = "import sys, speckle3d.study.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_titles_are_wrapped_to_narrow_panels():
    assert wrapped("image-based, consistent subset", 1.0).splitlines() == [
        "image-based,",
        "consistent",
        "subset",
    ]
    assert wrapped("image-based, consistent subset", 3.0) == "image-based, consistent subset"
