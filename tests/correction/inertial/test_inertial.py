"""Length by inertial scale, on poses and readings of simulated hands."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.length.inertial_cases import CENTRE_MM, WOBBLE, Setup, along, drawn
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.correction.inertial.expected import InertialPlan, expected_scale_error
from speckle3d.correction.inertial.scale import correct_inertial, turn_covariance
from speckle3d.correction.inertial.settings import InertialSettings

CURVES_SIGMA = 0.1


def corrected(case, **changed):
    given = {"sensor": case.sensor, **changed}
    return correct_inertial(
        case.image, case.covariance, CURVES_SIGMA, given["sensor"], case.time_s, CENTRE_MM
    )


@pytest.fixture(scope="module")
def wobbled():
    return drawn(replace(WOBBLE, duration_s=5.0, frame_rate_hz=25.0), 4)


def test_a_wobble_gives_the_length_that_curves_miss(wobbled):
    found = corrected(wobbled)
    image = along(wobbled.image) / wobbled.length_mm - 1.0
    length = along(found.poses) / wobbled.length_mm - 1.0
    # The claimed deviation is 0.8 %, the images are 13 % off; seed 4.
    assert abs(image) > 0.1
    assert abs(length) < 0.02
    assert abs(length) < 3.0 * found.log_scale_sigma
    assert found.log_scale_sigma < 0.02
    assert found.scale == pytest.approx(np.exp(wobbled.log_scale), rel=0.04)
    (evidence,) = found.evidence
    assert evidence.source == "inertial"
    assert evidence.information[0, 0] == pytest.approx(found.log_scale_sigma**-2)
    assert not evidence.information[1:].any()
    assert "follows the probe" in found.details["assumption"]
    turn = (wobbled.truth[0].inv() * wobbled.truth[-1]).inv() * (found.poses[0].inv() * found.poses[-1])
    # Inclination wanders by 0.15 degrees, times at most 1.5, in 40 s.
    assert abs(turn.rotation.as_rotvec(degrees=True)[0]) < 0.3
    assert np.allclose(found.poses[0].translation, 0.0)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"gyroscope_rad_s": None}, InsufficientDataError, "expected gyroscope_rad_s"),
        ({"accelerometer_m_s2": None}, InsufficientDataError, "expected accelerometer_m_s2"),
        ({"sensor_from_image": None}, InsufficientDataError, "not calibrated to the image"),
    ],
)
def test_what_is_missing_is_named(wobbled, changes, error, words):
    with pytest.raises(error, match=words):
        corrected(wobbled, sensor=replace(wobbled.sensor, **changes))


def test_units_of_g_are_refused(wobbled):
    force = wobbled.sensor.accelerometer_m_s2 / 9.81
    with pytest.raises(MismatchError, match="feels gravity"):
        corrected(wobbled, sensor=replace(wobbled.sensor, accelerometer_m_s2=force))


def test_a_saturated_gyroscope_is_refused(wobbled):
    rate = wobbled.sensor.gyroscope_rad_s
    limit = np.quantile(np.abs(rate), 0.9)
    with pytest.raises(InsufficientDataError, match="within the sensor's range"):
        corrected(wobbled, sensor=replace(wobbled.sensor, gyroscope_rad_s=np.clip(rate, -limit, limit)))


def test_few_readings_a_second_are_refused(wobbled):
    sensor = wobbled.sensor
    thin = slice(None, None, round(len(sensor.readings) / 5.6 / 25.0))
    readings = replace(
        sensor.readings,
        time_s=sensor.readings.time_s[thin],
        world_from_sensor=sensor.readings.world_from_sensor[thin],
    )
    slow = replace(
        sensor,
        readings=readings,
        accelerometer_m_s2=sensor.accelerometer_m_s2[thin],
        gyroscope_rad_s=sensor.gyroscope_rad_s[thin],
    )
    with pytest.raises(InsufficientDataError, match="readings a second"):
        corrected(wobbled, sensor=slow)


def test_images_that_go_the_other_way_are_contradicted(wobbled):
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    image = type(wobbled.image).from_matrix(flip @ wobbled.image.as_matrix() @ flip)
    with pytest.raises(MismatchError, match="the other way for"):
        corrected(replace(wobbled, image=image))


@pytest.mark.parametrize(
    ("held", "heading"),
    # Beam down; beam level with the array level; beam level with the array upright.
    [([-90, 0, 0], 1), ([0, 0, 0], 2), ([90, 90, 0], 0)],
)
def test_heading_is_the_angle_about_the_vertical_however_the_probe_is_held(held, heading):
    settings = InertialSettings()
    world_from_image = Rotation.from_euler("xyz", held, degrees=True)
    found = np.rad2deg(np.sqrt(np.diag(turn_covariance(world_from_image, settings))))
    expected = np.full(3, settings.orientation_sigma_deg)
    expected[heading] = settings.heading_sigma_deg
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_gentle_hand_is_refused_with_what_to_do():
    with pytest.raises(InsufficientDataError, match="wobble the probe"):
        corrected(drawn(Setup(duration_s=4.0, frame_rate_hz=25.0), 3))


@pytest.mark.slow
def test_a_wobble_is_expected_to_tell_more_than_a_tremor():
    wobble, tremor = (
        expected_scale_error(InertialPlan(duration_s=3.0, wobble_mm=size)) for size in (0.5, 0.0)
    )
    assert wobble.length < 0.5 * tremor.length
    assert tremor.refused
    assert not wobble.refused


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setup", "median", "ninetieth"),
    # Medians of 48 cases were 0.75 % (wobble) and 1.5 % (tremor); the target is 1.5 and 4 %.
    [(WOBBLE, 0.015, 0.04), (Setup(tremor_mm=0.05), 0.03, 0.06)],
)
def test_lengths_hold_over_sensors_levers_clocks_and_rates(setup, median, ninetieth):
    off, sigma = [], []
    for seed in range(801, 817):
        case = drawn(setup, seed)
        try:
            found = corrected(case)
        except InsufficientDataError:
            continue
        off.append(abs(along(found.poses) / case.length_mm - 1.0))
        sigma.append(found.log_scale_sigma)
    assert len(off) >= 12
    assert np.median(off) < median
    assert np.quantile(off, 0.9) < ninetieth
    assert np.mean(np.array(off) < 2.0 * np.array(sigma)) >= 0.8


@pytest.mark.slow
def test_tissue_that_follows_costs_as_much_as_stated_and_does_not_show():
    """What the documentation says no data can tell."""
    case, followed = (
        drawn(replace(WOBBLE, clean=True, follow=f, frame_rate_hz=25.0), 4) for f in (0.0, 0.05)
    )
    still, moved = corrected(case), corrected(followed)
    assert moved.log_scale - still.log_scale == pytest.approx(0.05, abs=0.015)
    assert moved.details["chi_squared"] == pytest.approx(still.details["chi_squared"], abs=0.02)


@pytest.mark.slow
def test_what_is_expected_comes():
    """Before the scan: the deviation of cases with that sensor, lever and motion."""
    found = [corrected(drawn(replace(WOBBLE, frame_rate_hz=25.0), seed)).log_scale_sigma for seed in range(8)]
    expected = expected_scale_error(InertialPlan()).length
    # Sensors half to one and a half times as noisy, levers of 50 to 170 mm.
    assert 0.5 * expected < np.median(found) < 1.6 * expected
