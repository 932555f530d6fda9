"""What a calibration's report shows."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_examples import line_directions

from calibration.job import as_calibration
from calibration.orientation import calibrate_orientation
from calibration.report import Shot, figure_report, text_report
from speckle3d.core.calibration import FramesUsed


@pytest.fixture(scope="module")
def turned():
    """An orientation sensor's solution and calibration, columns being four times as far apart as rows."""
    directions, readings, _ = line_directions(np.random.default_rng(3), 60)
    directions = directions / [0.4, 0.1]
    solution = calibrate_orientation(directions, np.arange(60), readings, np.array([0.4, 0.1]), level=True)
    return solution, as_calibration(solution, "orientation", FramesUsed(60, (), {}))


def test_images_have_their_true_proportions_though_only_the_ratio_is_known(turned):
    shot = Shot(3, np.zeros((20, 80), np.uint8), np.array([[0.0, 10.0], [19.0, 12.0]]), True)
    figure = figure_report(*turned, [shot])
    assert figure.axes[0].get_aspect() == pytest.approx(0.25)


@pytest.mark.parametrize(("count", "named", "more"), [(0, 0, 0), (20, 20, 0), (23, 20, 3)])
def test_frames_left_out_are_named_with_their_reasons(turned, count, named, more):
    dropped = {number: f"no line: {number} of 60" for number in reversed(range(count))}
    held = replace(turned[1], frames=FramesUsed(60, (59,), dropped))
    lines = text_report(held).splitlines()
    assert sum(line.startswith("  ") and ": no line: " in line for line in lines) == named
    assert ("Frames left out:" in lines) == (count > 0)
    assert any(f"and {more} more" in line for line in lines) == (more > 0)
    if count:
        assert lines[lines.index("Frames left out:") + 1] == "  0: no line: 0 of 60"
