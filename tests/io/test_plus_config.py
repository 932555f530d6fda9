import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError
from speckle3d.io.plus_config import read_wire_phantom

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
    assert phantom.world_from_phantom is None
    assert config.pixel_mm == 0.078
    # 766 columns from number 27 end with number 792.
    np.testing.assert_array_equal(config.clip_px, [[27, 28], [792, 28], [792, 589], [27, 589]])


def test_a_file_without_segmentation_gives_no_hints(tmp_path):
    config = read_wire_phantom(device_set(tmp_path))
    assert config.pixel_mm is None
    assert config.clip_px is None


@pytest.mark.parametrize(
    ("ends", "inverse"), [(("Phantom", "Reference"), False), (("Reference", "Phantom"), True)]
)
def test_the_phantoms_pose_is_read_either_way_round(tmp_path, ends, inverse):
    phantom = read_wire_phantom(device_set(tmp_path, transforms=POSE.format(*ends))).phantom
    pose = phantom.world_from_phantom.inv() if inverse else phantom.world_from_phantom
    np.testing.assert_allclose(pose.apply([1.0, 2.0, 3.0]), [8.0, 21.0, 33.0])


def test_frames_go_by_the_names_the_file_gives_them(tmp_path):
    tail = '<vtkPlusProbeCalibrationAlgo PhantomCoordinateFrame="Box" ReferenceCoordinateFrame="Table" />'
    text = POSE.format("Phantom", "Reference").replace("10", "99") + POSE.format("Box", "Table")
    phantom = read_wire_phantom(device_set(tmp_path, transforms=text, tail=tail)).phantom
    np.testing.assert_allclose(phantom.world_from_phantom.translation, [10.0, 20.0, 30.0])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"patterns": ""}, "PhantomDefinition/Geometry"),
        ({"patterns": N.replace("NWire", "Zigzag")}, r"Pattern\[0\].*'Zigzag'"),
        ({"patterns": N + '<Pattern Type="NWire" />'}, r"Pattern\[1\].*3.*0"),
        ({"patterns": N.replace('"30 0 20"', '"30 0"')}, "Wire a: EndPointFront.*3"),
        ({"patterns": N.replace("35 40 20", "nan 40 20")}, "Wire b: EndPointBack.*3"),
        ({"patterns": N.replace("EndPointBack", "Back")}, "Wire a: EndPointBack.*3"),
        ({"patterns": N.replace('"b"', '"a"')}, "names.*'a'"),
        (
            {"transforms": POSE.format("Phantom", "Reference").replace("0 -1 0", "0 -2 0")},
            r"Transform Phantom to Reference: Matrix\[0\]",
        ),
        ({"transforms": '<Transform From="Phantom" To="Reference" />'}, "Transform Phantom: Matrix.*16"),
        ({"segmentation": SEGMENTATION.replace("0.078", "-1")}, "ApproximateSpacing.*-1"),
        ({"segmentation": SEGMENTATION.replace("766", "0")}, "Segmentation: clip"),
    ],
)
def test_what_is_missing_or_wrong_is_named_on_one_line(tmp_path, parts, message):
    path = device_set(tmp_path, **parts)
    with pytest.raises(InvalidInputError, match=f"^{re.escape(str(path))}: .*{message}") as caught:
        read_wire_phantom(path)
    assert "\n" not in str(caught.value)


ENTITIES = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><a>&b;</a>'
OUTSIDE = '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/hostname">]><a>&x;</a>'


@pytest.mark.parametrize("text", [ENTITIES, OUTSIDE, '<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>'])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_documents_that_declare_entities_are_refused(tmp_path, text, encoding):
    path = tmp_path / "hostile.xml"
    path.write_bytes(text.encode(encoding))
    with pytest.raises(InvalidInputError, match="document type declaration"):
        read_wire_phantom(path)


@given(text=st.binary(max_size=60), cut=st.integers(0, 600))
@settings(deadline=None, max_examples=60)
def test_damaged_files_are_refused_and_nothing_else(tmp_path_factory, text, cut):
    whole = device_set(tmp_path_factory.mktemp("set"))
    content = whole.read_bytes()
    whole.write_bytes(content[:cut] + text + content[cut + len(text) :])
    try:
        read_wire_phantom(whole)
    except Speckle3DError as error:
        assert "\n" not in str(error)  # noqa: PT017


def test_a_missing_file_is_a_file_error(tmp_path):
    with pytest.raises(FileError, match="cannot be read"):
        read_wire_phantom(tmp_path / "none.xml")


@pytest.mark.realdata
def test_the_published_device_set_is_read(realdata):
    config = read_wire_phantom(realdata / "plus" / "PlusDeviceSet_fCal_Sim_SpatialCalibration_2.0.xml")
    assert config.phantom.n_shapes == ((0, 1, 2), (3, 4, 5), (6, 7, 8))
    assert config.phantom.names[4] == "5:H3_l3"
    np.testing.assert_array_equal(config.clip_px[[0, 2]], [[27, 27], [792, 588]])
    np.testing.assert_allclose(config.phantom.world_from_phantom.translation, [15.6642, -25.3628, -40.7799])


@pytest.mark.realdata
def test_a_device_set_without_phantom_is_refused(realdata):
    with pytest.raises(InvalidInputError, match="PhantomDefinition/Geometry"):
        read_wire_phantom(realdata / "plus" / "BoneUltrasound_L14_config.xml")
