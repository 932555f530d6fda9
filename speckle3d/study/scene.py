"""A folder that opens in 3D Slicer as one scene: volumes, where voxels are from, frames' outlines and poses.

A scene file (.mrml) lists nodes. A node that has a file refers to a storage node, which names the file
relative to the scene's folder [1]_.

References
----------
.. [1] 3D Slicer, sources of vtkMRMLScene and of the storage nodes named here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import jinja2
import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.labels import STATE_SEGMENTS, LabelMap
from speckle3d.core.printable import printable
from speckle3d.core.volume import Volume
from speckle3d.imaging.outlines import frame_outlines
from speckle3d.imaging.volume import DEFAULT_FILL_RADIUS, compound
from speckle3d.io.fileset import FileSet
from speckle3d.io.polylines import write_polylines
from speckle3d.io.transforms import write_transform
from speckle3d.io.volumes import write_volume
from speckle3d.study.posed import PosedSweep

SCENE = "scene.mrml"
_TEMPLATE = Path(__file__).with_name("scene.mrml")
_COLOURS = ("0.2 0.6 1", "1 0.5 0.1", "0.3 0.8 0.3", "0.9 0.3 0.3", "0.6 0.4 0.9", "0.6 0.5 0.3")
"""Of the outlines of one mode after the other."""
_VIEWS = ("Red", "Green", "Yellow")


@dataclass(frozen=True)
class SceneSettings:
    """What goes into a scene.

    Attributes
    ----------
    voxel_mm : float
    fill_radius : int
    dynamic_range_db : float
    """

    voxel_mm: float = 0.2
    fill_radius: int = DEFAULT_FILL_RADIUS
    dynamic_range_db: float = 60.0


@dataclass(frozen=True)
class _Node:
    tag: str
    attributes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Files:
    """Names of the files of one mode."""

    volume: str
    state: str
    outlines: str
    first: str

    @classmethod
    def of(cls, mode: str) -> _Files:
        names = ("volume-{}.nrrd", "state-{}.seg.nrrd", "outlines-{}.vtk", "first-frame-{}.tfm")
        return cls(*(name.format(mode) for name in names))

    @property
    def all(self) -> tuple[str, ...]:
        return self.volume, self.state, self.outlines, self.first


def write_scene(
    folder: PathLike,
    posed: Sequence[PosedSweep],
    settings: SceneSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a folder with a scene and all that it refers to; it appears whole or not at all.

    Parameters
    ----------
    folder : path
        New, or one that holds a scene of the same modes, which is replaced.
    posed : sequence of PosedSweep
        One sweep with the poses of one mode or more.
    settings : SceneSettings, optional
    progress : callable, optional
        Called with the number of frames compounded and their total, mode after mode.

    Raises
    ------
    InvalidInputError
        If there is no mode, or one twice.
    FileError
        If the folder cannot be written.
    """
    modes = [each.mode for each in posed]
    if not modes or len({*modes}) != len(modes):
        raise InvalidInputError(f"{folder}: expected one mode or more, each once, got {modes}")
    others = [name for mode in modes for name in _Files.of(mode).all]
    with FileSet(SCENE, tuple(others)).replaced(Path(folder)) as part:
        for each in posed:
            _write_mode(part, each, settings or SceneSettings(), progress)
        (part / SCENE).write_text(scene_text(modes, posed[0].sweep.name), encoding="utf-8")


def require_scene_place(folder: Path, *inputs: Path | None) -> None:
    """Refuse to write a scene into a folder that holds an input, or other things than a scene.

    Raises
    ------
    InvalidInputError
        Naming the folder.
    """
    if not folder.exists():
        return
    if any(each is not None and each.resolve().parent == folder.resolve() for each in inputs):
        raise InvalidInputError(f"{folder}: holds an input: give another name")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / SCENE).is_file():
        raise InvalidInputError(f"{folder}: expected a new name or a scene to replace, got another folder")


def scene_text(modes: Sequence[str], title: str) -> str:
    """Scene of the modes' files as text.

    Parameters
    ----------
    title : str
        What names of nodes begin with.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    nodes = [node for i, mode in enumerate(modes, 1) for node in _mode_nodes(i, mode, printable(title))]
    return template.render(nodes=[*nodes, *_view_nodes()])


def _write_mode(
    folder: Path, posed: PosedSweep, settings: SceneSettings, progress: Callable[[int, int], None] | None
) -> None:
    files = _Files.of(posed.mode)
    images, grid = posed.images(settings.dynamic_range_db, progress)
    poses, voxel_mm = posed.world_from_image, settings.voxel_mm
    volume = compound(images, grid, poses, voxel_mm, fill_radius=settings.fill_radius)
    measured = compound(images, grid, poses, voxel_mm, fill_radius=0)
    state = np.where(np.isfinite(measured.voxels), 1, np.where(np.isfinite(volume.voxels), 2, 0))
    place = volume.spacing_mm, volume.world_from_grid
    levels = np.clip(np.nan_to_num(np.rint(volume.voxels)), 0, 255).astype(np.uint8)
    write_volume(folder / files.volume, Volume(levels, *place, volume.fields))
    write_volume(folder / files.state, LabelMap(state.astype(np.uint8), *place, {}, STATE_SEGMENTS))
    outlines = frame_outlines(grid, poses)
    write_polylines(folder / files.outlines, outlines, {"frame": posed.frames.astype(np.float64)})
    write_transform(folder / files.first, poses[0])


def _mode_nodes(i: int, mode: str, title: str) -> Iterator[_Node]:
    """Nodes of one mode, counted from 1; those that others refer to come first."""
    files, name = _Files.of(mode), f"{title}, {mode}"
    yield from _stored(
        "Volume", f"vtkMRMLScalarVolumeNode{i}", name,
        _storage("VolumeArchetypeStorage", i, files.volume, centerImage="0", UseOrientationFromFile="1"),
        _Node("VolumeDisplay", {
            "id": f"vtkMRMLScalarVolumeDisplayNode{i}", "colorNodeID": "vtkMRMLColorTableNodeGrey",
            "interpolate": "1", "autoWindowLevel": "0", "window": "255", "level": "127.5",
        }),
    )  # fmt: skip
    yield from _stored(
        "Segmentation", f"vtkMRMLSegmentationNode{i}", f"{name}: voxels measured and filled",
        _storage("SegmentationStorage", i, files.state),
        _Node("SegmentationDisplay", {
            "id": f"vtkMRMLSegmentationDisplayNode{i}", "visibility": "false", "opacity": "0.5",
        }),
        referenceImageGeometryRef=f"vtkMRMLScalarVolumeNode{i}",
    )  # fmt: skip
    yield from _stored(
        "Model", f"vtkMRMLModelNode{i}", f"{name}: frames",
        _storage("ModelStorage", i, files.outlines, coordinateSystem="LPS"),
        _Node("ModelDisplay", {
            "id": f"vtkMRMLModelDisplayNode{i}", "color": _COLOURS[(i - 1) % len(_COLOURS)],
            "lineWidth": "1", "representation": "1", "lighting": "false", "scalarVisibility": "false",
            "visibility": "true" if i == 1 else "false",
        }),
    )  # fmt: skip
    yield from _stored(
        "LinearTransform", f"vtkMRMLLinearTransformNode{i}", f"{name}: first frame",
        _storage("TransformStorage", i, files.first), None,
    )  # fmt: skip


def _view_nodes() -> Iterator[_Node]:
    """What the three slice views show: the first volume."""
    for view in _VIEWS:
        attributes = {
            "id": f"vtkMRMLSliceCompositeNode{view}", "singletonTag": view, "layoutName": view,
            "backgroundVolumeID": "vtkMRMLScalarVolumeNode1", "linkedControl": "1",
        }  # fmt: skip
        yield _Node("SliceComposite", attributes)


def _storage(tag: str, i: int, file: str, **attributes: str) -> _Node:
    # Names of files in a scene are URLs.
    place = {"id": f"vtkMRML{tag}Node{i}", "fileName": quote(file), "useCompression": "1"}
    return _Node(tag, {**place, **attributes})


def _stored(
    tag: str, identity: str, name: str, storage: _Node, display: _Node | None, **references: str
) -> Iterator[_Node]:
    """A node with its storage, its display and what else it refers to."""
    yield storage
    roles = {"storage": storage.attributes["id"], **references}
    if display is not None:
        yield display
        roles = {"display": display.attributes["id"], **roles}
    told = "".join(f"{role}:{to};" for role, to in roles.items())
    yield _Node(tag, {"id": identity, "name": name, "references": told})
