"""A device set gives what headers lack: pixels, the image on the probe, names of frames, pitch of lines."""

from dataclasses import replace

import numpy as np
import pytest
from igsio_twin import Clip
from image_examples import frame_fields, grey, write_mha
from scipy.spatial.transform import Rotation

from speckle3d.core.grid import ImageGrid, Region, ScanConversion
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.io.load import load_sweep, open_recording
from speckle3d.io.plus.device_set import read_device_set

TURN = Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix()


def matrix(columns=(0.1, 0.2, 0.15), place=(10.0, 20.0, 30.0)):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = TURN * columns, place
    return result


def text(values):
    return " ".join(map(repr, np.ravel(values).tolist()))


def write_set(path, *transforms, more="", scan=""):
    elements = "".join(f'<Transform From="{a}" To="{b}" Matrix="{text(m)}"/>' for a, b, m in transforms)
    path.write_text(
        f"<PlusConfiguration>{scan}{more}<CoordinateDefinitions>{elements}</CoordinateDefinitions></PlusConfiguration>"
    )
    return str(path)


def settings(config, **more):
    return ImportSettings(dynamic_range_db=60.0, plus_config=config, **more)


@pytest.fixture
def sequence(tmp_path):
    return write_mha(tmp_path / "a.mha", grey(), frames=frame_fields(3)[2])


HALF = np.eye(4)
HALF[:3, 3] = -2.5, 5.0, 0.0


@pytest.mark.parametrize(
    "transforms",
    [
        [("Image", "Probe", matrix())],
        [("Probe", "Image", np.linalg.inv(matrix()))],
        [
            ("Phantom", "Reference", np.eye(4)),
            ("TransducerOriginPixel", "Image", np.linalg.inv(HALF)),
            ("Probe", "TransducerOriginPixel", HALF @ np.linalg.inv(matrix())),
        ],
    ],
)
def test_the_image_on_the_probe_in_either_direction(tmp_path, sequence, transforms):
    sweep = load_sweep(sequence, settings(write_set(tmp_path / "set.xml", *transforms)))
    assert sweep.grid.vector_pitch_mm == pytest.approx(0.1, abs=1e-12)
    assert sweep.grid.sample_spacing_mm == pytest.approx(0.2, abs=1e-12)
    mounting = sweep.tracker.sensor_from_image
    np.testing.assert_allclose(mounting.translation, [10, 20, 30], atol=1e-9)
    np.testing.assert_allclose(mounting.rotation.as_matrix(), TURN, atol=1e-9)


def test_the_machine_names_orientation_and_tool_where_the_header_does_not(tmp_path, sequence):
    config = write_set(tmp_path / "set.xml", ("Image", "Reference", matrix()),
                     more='<Set PortUsImageOrientation="UN" ProbeCoordinateFrame="Reference"/>')  # fmt: skip
    np.testing.assert_array_equal(load_sweep(sequence, settings(config)).frames[0], grey()[0, ::-1, ::-1].T)
    assert open_recording(sequence, settings(config)).chain == "ImageToReference * ReferenceToTracker"
    path = write_mha(tmp_path / "a.mha", grey(), {"UltrasoundImageOrientation": "MF"}, frame_fields(3)[2])
    np.testing.assert_array_equal(load_sweep(path, settings(config)).frames[0], grey()[0].T)


def test_the_pitch_of_rf_lines_but_not_the_image_of_them(tmp_path):
    scan = '<ScanConversion TransducerGeometry="{}" TransducerWidthMm="38.4" ImagingDepthMm="40"/>'
    rf = write_mha(tmp_path / "rf.mha", np.ones((2, 12, 30), np.int16), frames=frame_fields(2)[2])
    config = write_set(tmp_path / "set.xml", ("Image", "Probe", matrix()), scan=scan.format("LINEAR"))
    more = {"centre_frequency_hz": 5e6, "bandwidth_hz": (3e6, 7e6)}
    sweep = load_sweep(rf, settings(config, sampling_rate_hz=40e6, **more))
    assert sweep.grid.vector_pitch_mm == pytest.approx(38.4 / 12)
    assert sweep.tracker.sensor_from_image is None  # of the B-mode image's pixels
    config = write_set(tmp_path / "set.xml", scan=scan.format("CURVILINEAR"))
    with pytest.raises(MissingSettingsError) as error:
        load_sweep(rf, settings(config, sampling_rate_hz=40e6, **more))
    assert set(error.value.settings) == {"array_radius_mm", "line_angles_deg"}


def test_lines_of_a_curved_transducer(tmp_path):
    places = 'RadiusStartMm="50" RadiusStopMm="65" ThetaStartDeg="-10" ThetaStopDeg="5"'
    scan = f'<ScanConversion TransducerGeometry="CURVILINEAR" {places}/>'
    config = write_set(tmp_path / "set.xml", scan=scan)
    rf = write_mha(tmp_path / "rf.mha", np.ones((2, 12, 301), np.int16), frames=frame_fields(2)[2])
    sweep = load_sweep(rf, settings(config, centre_frequency_hz=3e6, bandwidth_hz=(2e6, 3.8e6)))
    assert sweep.grid.sample_spacing_mm == pytest.approx(15.0 / 300)
    assert sweep.grid.fan.radius_mm == 50.0
    np.testing.assert_allclose(np.rad2deg(sweep.grid.angle_rad([0, 11])), [-10, 5])


def test_picture_of_curved_lines_is_that_of_plus(realdata):
    """Other frames of the same scene, mirrored and of other grey levels: alike, and not 3 mm off."""
    config = realdata / "plus" / "PlusDeviceSet_RfProcessingAlgoCurvilinearTest.xml"
    machine = settings(str(config))
    lines = load_sweep(realdata / "plus" / "UltrasonixCurvilinearBrightnessData.igs.mha", machine)
    picture = realdata / "plus" / "UltrasonixCurvilinearScanConvertedDataGroundTruth.igs.mha"
    pixels = ImportSettings(
        column_pitch_mm=0.15, row_spacing_mm=0.15, dynamic_range_db=60.0, frame_rate_hz=3.0
    )
    reference = load_sweep(picture, pixels).frames[0].astype(float)

    def alike(off_mm):
        # The set has the middle of the array's face at pixel 410, 87.
        apex = 410 * 0.15, 87 * 0.15 - 10.0 + off_mm
        fan = replace(lines.grid, fan=replace(lines.grid.fan, apex_mm=apex))
        ours = ScanConversion(fan, ImageGrid(*reference.shape, 0.15, 0.15))(lines.frames[0][::-1])
        inside = np.isfinite(ours)
        return np.corrcoef(ours[inside], reference[inside])[0, 1]

    assert alike(0.0) > 0.8
    assert alike(0.0) > max(alike(-3.0), alike(3.0)) + 0.1


def test_the_clip_of_volumes_is_that_of_plus(tmp_path):
    """Of the rule in IGSIO, written apart; the sides of the fan are a pixel towards its middle."""
    clip = '<VolumeReconstruction ClipRectangleOrigin="192 16" ClipRectangleSize="420 580" {}/>'
    fan = ('FanAnglesDeg="-45 45" FanOriginPixel="380 20" FanRadiusStartPixel="120" '
           'FanRadiusStopPixel="360"')  # fmt: skip
    grid = ImageGrid(820, 616, 0.085, 0.079, 3.0, 0.05)
    for text, angles in (("", None), (fan, (380, 20, 120, 360, -45, 45))):
        device = read_device_set(write_set(tmp_path / "set.xml", scan=clip.format(text)))
        expected = Clip((192, 612), (16, 596), angles).mask(820, 616).T
        mask = Region(device.clip_region(grid)).mask(grid)
        assert (mask != expected).mean() < (0.0003 if angles else 1e-9)
