from dataclasses import replace

import numpy as np
import pytest
import speckle

from speckle3d.core.errors import InvalidInputError, MismatchError


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
        key = replace(speckle.KEY, signal=replace(speckle.RF, **{setting: value}))
    else:
        key = replace(speckle.KEY, **{setting: value})
    with pytest.raises(MismatchError, match=f"{setting} of c.h5 is "):
        speckle.KEY.require_same(key, "c.h5")


def test_curves_serve_the_probe_however_its_echoes_were_sampled():
    """The matching resamples every signal to one rate, which its band decides."""
    faster = replace(speckle.RF, sampling_rate_hz=50e6)
    low, high = speckle.RF.bandwidth_hz
    baseband = replace(
        speckle.RF, sampling_rate_hz=1.3 * (high - low), demodulation_frequency_hz=(low + high) / 2
    )
    for signal in (faster, baseband):
        key = replace(speckle.KEY, signal=signal)
        speckle.KEY.require_same(key)
        key.require_same(speckle.KEY)


def test_curves_of_another_probe_are_refused_where_both_are_named():
    near_focus, far_focus = (
        replace(speckle.KEY, probe=name) for name in ("L12-5, focus 2 cm", "L12-5, focus 3 cm")
    )
    near_focus.require_same(near_focus)
    near_focus.require_same(speckle.KEY)
    speckle.KEY.require_same(far_focus)
    with pytest.raises(MismatchError):
        near_focus.require_same(far_focus)


def test_between_two_depths_the_width_lies_between():
    curves = speckle.curves(sigma_mm=[0.3, 0.6], depth_mm=(10.0, 20.0))
    between = curves.at(np.array([10.0, 15.0, 20.0, 15.0]))
    d = curves.distance_mm[:60]
    for row, width in zip(between.correlation, (0.3, 0.4, 0.6, 0.4), strict=True):
        # sqrt(-ln rho) = d / (sigma sqrt 2) is linear in 1 / sigma: halfway lies 2 / (1/.3 + 1/.6) = 0.4.
        np.testing.assert_allclose(row[:60], speckle.gaussian_correlation(d, width), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("correlation", lambda rho: np.where(rho > 0.9, np.nan, rho)),
        ("correlation", lambda rho: rho[:, ::-1]),
        ("distance_mm", lambda distance: distance**1.1),
        ("cells", lambda cells: cells[:1]),
    ],
)
def test_curves_that_cannot_be_are_refused(name, spoil):
    curves = speckle.curves()
    with pytest.raises(InvalidInputError, match=name):
        replace(curves, **{name: spoil(getattr(curves, name))})


def test_curves_of_a_fan_are_of_its_array_however_deep_it_is_recorded():
    fan = replace(speckle.KEY, lines="fan", array_radius_mm=60.0, line_step_rad=0.005)
    fan.require_same(replace(fan, vector_pitch_mm=0.5))
    speckle.KEY.require_same(fan)  # of a file that does not say how lines lie
    parallel = replace(speckle.KEY, lines="parallel")
    for key in (replace(fan, array_radius_mm=40.0), replace(fan, line_step_rad=0.006), parallel):
        with pytest.raises(MismatchError):
            fan.require_same(key)
