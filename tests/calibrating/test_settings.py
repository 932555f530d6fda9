"""Settings as options of the command: what is written is read as the same."""

import shlex
import sys
from pathlib import Path

import pytest

from speckle3d import cli
from speckle3d.calibrating.settings import (
    OrientationSettings,
    PlaneSettings,
    WireSettings,
    command_line,
    frames_of,
)
from speckle3d.cli.calibrate import phantoms as calibrate_phantoms
from speckle3d.core.errors import InvalidInputError


def test_frames_are_numbers_and_ranges():
    assert frames_of("4, 3,17-20,18") == (3, 4, 17, 18, 19, 20)
    assert frames_of("") == ()
    for text in ("3;4", "5-3", "1.5", "0-9999999"):
        with pytest.raises(InvalidInputError):
            frames_of(text)


@pytest.mark.parametrize(
    "settings",
    [
        PlaneSettings(
            poses=Path("its poses.mha"), transform="ProbeToTracker", pixel_mm=(0.1, 1 / 3),
            time_offset_s=-0.01,
            outlier_sigma=3.5, region="0.5,1 20,1e-3 7.25,80", leave_out="0,3-5",
            columns=41, smoothing_mm=0.1 + 0.2, threshold=12.5, tolerance_mm=0.4, place="front",
            fixed_pixels=True, pixel_error=float("inf"), reflector="bar", beam_mm=[1.5, 2.0],
        ),
        OrientationSettings(level=True, viewed_from="below", sensor="tracker", time_offset_s="estimate"),
        WireSettings(phantom="three", points=Path("a b.csv"), registration="held", fixed_pixels=True),
    ],
)  # fmt: skip
def test_the_command_that_is_told_takes_the_same_settings(monkeypatch, settings, tmp_path):
    calls = []
    monkeypatch.chdir(tmp_path)
    for name in ("the images.mha", "its poses.mha", "a b.csv"):
        (tmp_path / name).touch()
    monkeypatch.setattr(
        calibrate_phantoms,
        "_calibrate",
        lambda images, options, out: calls.append((images, options, out)),
    )
    line = command_line(settings, Path("the images.mha"), Path("out.h5"))
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    with pytest.raises(SystemExit) as leave:
        cli.main()
    assert leave.value.code == 0
    assert calls == [(Path("the images.mha"), settings, Path("out.h5"))]
