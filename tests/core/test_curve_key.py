"""Curves of one array are not those of another."""

from dataclasses import replace

import pytest
from speckle import KEY

import speckle3d as s3

FAN = replace(KEY, lines="fan", array_radius_mm=60.0, line_step_rad=0.005)


@pytest.mark.parametrize(
    "other",
    [replace(FAN, array_radius_mm=40.0), replace(FAN, line_step_rad=0.006), replace(KEY, lines="parallel")],
    ids=["radius", "angle", "parallel"],
)
def test_another_fan_is_refused(other):
    with pytest.raises(s3.Speckle3DError):
        FAN.require_same(other)


def test_a_fan_recorded_deeper_is_the_same_array():
    FAN.require_same(replace(FAN, vector_pitch_mm=0.5))
    KEY.require_same(FAN)  # of a file that does not say how lines lie
