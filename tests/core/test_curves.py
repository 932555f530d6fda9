from dataclasses import replace

import numpy as np
import pytest
import speckle

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.sweep import BModeSettings

BMODE = BModeSettings(60.0)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("speed_of_sound_m_s", 1580.0),
        ("bandwidth_hz", (4e6, 9e6)),
        ("vector_pitch_mm", 1.25),
        ("correlation_of", "echo"),
    ],
)
def test_curves_of_another_signal_or_geometry_are_refused_and_the_setting_named(setting, value):
    if hasattr(speckle.RF, setting):
        other = replace(speckle.KEY, signal=replace(speckle.RF, **{setting: value}))
    else:
        other = replace(speckle.KEY, **{setting: value})
    with pytest.raises(MismatchError, match=f"^c.h5: {setting} is "):
        speckle.KEY.require_same(other, "c.h5")


def test_curves_serve_the_probe_however_its_echoes_were_sampled():
    """The matching resamples every signal to one rate, which its band decides."""
    faster = replace(speckle.RF, sampling_rate_hz=50e6)
    low, high = speckle.RF.bandwidth_hz
    baseband = replace(
        speckle.RF, sampling_rate_hz=1.3 * (high - low), demodulation_frequency_hz=(low + high) / 2
    )
    for other in (faster, baseband):
        key = replace(speckle.KEY, signal=other)
        speckle.KEY.require_same(key)
        key.require_same(speckle.KEY)


def test_curves_of_another_probe_are_refused_where_both_are_named():
    mine, theirs = (replace(speckle.KEY, probe=name) for name in ("L12-5, focus 2 cm", "L12-5, focus 3 cm"))
    mine.require_same(mine)
    mine.require_same(speckle.KEY)
    speckle.KEY.require_same(theirs)
    with pytest.raises(MismatchError):
        mine.require_same(theirs)


def test_between_two_depths_the_width_lies_between():
    made = speckle.curves(sigma_mm=[0.3, 0.6], depth_mm=(10.0, 20.0))
    between = made.at(np.array([10.0, 15.0, 20.0, 15.0]))
    d = made.distance_mm[:60]
    for row, width in zip(between.correlation, (0.3, 0.4, 0.6, 0.4), strict=True):
        # sqrt(-ln rho) = d / (sigma sqrt 2) is linear in 1 / sigma: halfway lies 2 / (1/.3 + 1/.6) = 0.4.
        np.testing.assert_allclose(row[:60], speckle.gaussian_correlation(d, width), rtol=1e-9)


def spoiled(**changes):
    made = speckle.curves()
    arrays = {
        name: getattr(made, name).copy() for name in ("depth_mm", "distance_mm", "correlation", "cells")
    }
    for name, change in changes.items():
        arrays[name] = change(arrays[name])
    return lambda: DecorrelationCurves(made.key, **arrays)


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"correlation": put((1, 5), np.nan)}, "correlation"),
        ({"correlation": put((1, 30), 0.999)}, "fall"),
        ({"distance_mm": lambda a: a**1.1}, "distance_mm"),
        ({"cells": lambda a: a[:1]}, "cells"),
    ],
)
def test_curves_that_cannot_be_are_refused(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        spoiled(**changes)()
