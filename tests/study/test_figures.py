"""Curves of a reconstruction as they are drawn."""

import numpy as np
import pytest
from drifting import CENTRE_MM, drifted, hand_sweep, tracked

from speckle3d.core.errors import FileError, MismatchError
from speckle3d.core.reconstruction import MODES as RECONSTRUCTED
from speckle3d.scoring.lengths import accumulated, compare_modes
from speckle3d.scoring.references import Reference, sweep_curves
from speckle3d.study.figures import colour_of, curve_panels, figure_drift, label_of, save_figure

FRAMES = 60


@pytest.fixture(scope="module")
def sweep():
    rng = np.random.default_rng(8)
    truth = hand_sweep(rng, FRAMES)
    return drifted(truth, rng), tracked(truth, rng)


def curves_of(poses, tracker=None, covered=None, covariance=None):
    covered = np.ones(FRAMES, dtype=bool) if covered is None else covered
    reference = None if tracker is None else Reference("tracker", tracker[covered], covered)
    return sweep_curves(poses, CENTRE_MM, reference, covariance)


def test_every_mode_and_the_reference_are_drawn_and_named_in_both_panels(sweep):
    image, tracker = sweep
    figure = figure_drift(curves_of({"image": image, "pose": image}, tracker))
    offset, tilt = figure.axes
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == ["tracker", "image", "pose"]
        assert axes.get_legend() is not None
    motion = accumulated(image, CENTRE_MM)
    np.testing.assert_allclose(offset.lines[1].get_ydata(), motion.length_mm)
    np.testing.assert_allclose(tilt.lines[1].get_ydata(), np.rad2deg(motion.tilt_rad))
    assert offset.lines[1].get_color() == colour_of("image") == tilt.lines[1].get_color()


def test_the_images_95_percent_interval_is_a_band(sweep):
    deviation = np.linspace(0.0, 0.8, FRAMES)
    covariance = np.zeros((FRAMES, 6, 6))
    # Along z, mm, and tilt, rad; across the images does not count.
    covariance[:, 2, 2], covariance[:, 3, 3] = deviation**2, (0.01 * deviation) ** 2
    covariance[:, 0, 0] = 1e6
    length, tilt, *_ = curve_panels(curves_of({"image": sweep[0], "pose": sweep[0]}, covariance=covariance))
    for panel, width in ((length, deviation), (tilt, np.rad2deg(0.01 * deviation))):
        (band,) = [each for each in panel.series if each.style == "band"]
        np.testing.assert_allclose(band.points[:, 1] - band.low, 2 * 1.96 * width, atol=1e-9)
    # No band without the curve that it belongs to.
    assert curves_of({"pose": sweep[0]}, covariance=covariance).half_width is None


def test_the_reference_has_gaps_and_curves_and_table_have_one_length(sweep):
    image, tracker = sweep
    covered = np.ones(FRAMES, dtype=bool)
    covered[20:30] = False
    drawn = curves_of({"image": image}, tracker, covered).reference[0]
    np.testing.assert_array_equal(np.isnan(drawn), ~covered)
    # The curve is its own, whatever it is compared with, and begins where the line through its first readings
    # does, as the table's length.
    np.testing.assert_array_equal(drawn, curves_of({"pose": tracker}, tracker, covered).reference[0])
    (row,) = compare_modes({"image": image}, tracker, CENTRE_MM)
    whole = curves_of({"image": image}, tracker).reference[0]
    assert np.median(whole[-6:]) == pytest.approx(row.reference_mm, abs=1.5)


def test_a_reference_of_other_frames_is_refused(sweep):
    image, tracker = sweep
    with pytest.raises(MismatchError, match=r"reference.*60.*60.*59"):
        sweep_curves({"image": image}, CENTRE_MM, Reference("truth", tracker[1:], np.ones(60, dtype=bool)))


def test_a_png_of_150_dots_per_inch_appears_whole(sweep, tmp_path):
    figure = figure_drift(curves_of({"image": sweep[0]}))
    path = save_figure(figure, tmp_path / "new" / "drift.png")
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20], "big") == 1500
    assert [p.name for p in path.parent.iterdir()] == ["drift.png"]
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        save_figure(figure, tmp_path / "file" / "drift.png")


def test_neither_pyplot_nor_a_window_system_is_touched(python):
    code = "import sys, speckle3d.study.figures; print('matplotlib.pyplot' in sys.modules)"
    assert python(code) == "False\n"


def test_modes_go_by_their_names_and_have_colours_of_their_own():
    modes = [*RECONSTRUCTED, "tracker", "truth", "bent"]
    assert len({colour_of(mode, modes) for mode in modes}) == len(modes)
    assert (label_of("pose"), label_of("tracker")) == ("pose", "tracker alone")
