import numpy as np
import pytest

from speckle3d.io.plus.device_set import read_wire_phantom

N = """<Pattern Type="NWire">
  <Wire Name="a" EndPointFront="30 0 20" EndPointBack="30 40 20" />
  <Wire Name="b" EndPointFront="55 0 20" EndPointBack="35 40 20" />
  <Wire EndPointFront="60 0 20" EndPointBack="60 40 20" />
</Pattern>"""
PARALLEL = """<Pattern Type="CoplanarParallelWires">
  <Wire Name="p" EndPointFront="0 0 0" EndPointBack="0 40 0" />
  <Wire Name="q" EndPointFront="9 0 0" EndPointBack="9 40 0" />
</Pattern>"""
POSE = '<Transform From="{}" To="{}" Matrix="0 -1 0 10  1 0 0 20  0 0 1 30  0 0 0 1" />'
SEGMENTATION = """<Segmentation ApproximateSpacingMmPerPixel="0.078"
  ClipRectangleOrigin="27 28" ClipRectangleSize="766 562" />"""


def device_set(tmp_path, patterns=N, transforms="", segmentation="", tail=""):
    path = tmp_path / "set.xml"
    path.write_text(
        f"""<PlusConfiguration version="2.1">
        <CoordinateDefinitions>{transforms}</CoordinateDefinitions>{segmentation}
        <PhantomDefinition><Geometry>{patterns}</Geometry></PhantomDefinition>{tail}
        </PlusConfiguration>"""
    )
    return path


def test_wires_patterns_and_hints_are_read(tmp_path):
    config = read_wire_phantom(device_set(tmp_path, PARALLEL + N, segmentation=SEGMENTATION))
    phantom = config.phantom
    assert phantom.names == ("p", "q", "a", "b", "2.3")
    assert phantom.patterns == ((0, 1), (2, 3, 4))
    assert phantom.n_shapes == ((2, 3, 4),)
    np.testing.assert_array_equal(phantom.ends_mm[3], [[55, 0, 20], [35, 40, 20]])
    assert config.pixel_mm == 0.078
    # 766 columns from number 27 end with number 792.
    np.testing.assert_array_equal(config.clip_px, [[27, 28], [792, 28], [792, 589], [27, 589]])
    plain = read_wire_phantom(device_set(tmp_path))
    assert (plain.pixel_mm, plain.clip_px, plain.phantom.world_from_phantom) == (None, None, None)


@pytest.mark.parametrize(
    ("phantom", "reference", "inverse"),
    [("Phantom", "Reference", False), ("Reference", "Phantom", True), ("Box", "Table", False)],
)
def test_the_phantoms_pose_is_read_either_way_round_by_the_names_of_the_set(
    tmp_path, phantom, reference, inverse
):
    tail = '<vtkPlusProbeCalibrationAlgo PhantomCoordinateFrame="Box" ReferenceCoordinateFrame="Table" />'
    algorithm = tail if phantom == "Box" else ""
    path = device_set(tmp_path, transforms=POSE.format(phantom, reference), tail=algorithm)
    pose = read_wire_phantom(path).phantom.world_from_phantom
    np.testing.assert_allclose((pose.inv() if inverse else pose).apply([1.0, 2.0, 3.0]), [8.0, 21.0, 33.0])
