"""A folder that opens in 3D Slicer as one scene: volumes, where voxels are from, frames' outlines and poses.

A scene file (.mrml) lists nodes. A node that has a file refers to a storage node, which names the file
relative to the scene's folder [1]_.

References
----------
.. [1] 3D Slicer, sources of vtkMRMLScene and of the storage nodes named here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import jinja2
import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.labels import STATE_SEGMENTS, LabelMap
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
        return cls(f"volume-{mode}.nrrd", f"state-{mode}.seg.nrrd", f"outlines-{mode}.vtk", f"first-{mode}.tfm")

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


def scene_text(modes: Sequence[str], title: str) -> str:
    """Scene of the modes' files as text.

    Parameters
    ----------
    title : str
        What names of nodes begin with.
    """
    environment = jinja2.Environment(autoescape=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    nodes = [*_modes_nodes(modes, title), *_view_nodes()]
    return template.render(nodes=nodes)


def _write_mode(
    folder: Path, posed: PosedSweep, settings: SceneSettings, progress: Callable[[int, int], None] | None
) -> None:
    files = _Files.of(posed.mode)
    images, grid = posed.images(settings.dynamic_range_db, progress)
    volume = compound(
        images, grid, posed.world_from_image, settings.voxel_mm,
        fill_radius=settings.fill_radius, voxel_type="uint8",
    )  # fmt: skip
    write_volume(folder / files.volume, volume)
    place = volume.spacing_mm, volume.world_from_grid
    write_volume(folder / files.state, LabelMap(volume.state, *place, {}, STATE_SEGMENTS))
    outlines = frame_outlines(grid, posed.world_from_image)
    write_polylines(folder / files.outlines, outlines, {"frame": posed.frames.astype(np.float64)})
    write_transform(folder / files.first, posed.world_from_image[0])


def _modes_nodes(modes: Sequence[str], title: str) -> Iterator[_Node]:
    for i, mode in enumerate(modes, start=1):
        files, name = _Files.of(mode), f"{title} {mode}"
        visible = "true" if i == 1 else "false"
        yield from _stored(
            "Volume", "ScalarVolume", i, name, files.volume, "VolumeArchetypeStorage", "VolumeArchetype",
            {"UseOrientationFromFile": "1", "centerImage": "0"},
        )  # fmt: skip
        yield _displayed("VolumeDisplay", "ScalarVolumeDisplay", i, colorNodeID="vtkMRMLColorTableNodeGrey")
        yield from _stored(
            "Segmentation", "Segmentation", i, f"{name} voxels", files.state, "SegmentationStorage", "Segmentation",
            {}, f"referenceImageGeometryRef:vtkMRMLScalarVolumeNode{i};",
        )  # fmt: skip
        yield _displayed("SegmentationDisplay", "SegmentationDisplay", i, visibility="false", opacity="0.5")
        yield from _stored(
            "Model", "Model", i, f"{name} frames", files.outlines, "ModelStorage", "Model",
            {"coordinateSystem": "LPS"},
        )  # fmt: skip
        yield _displayed(
            "ModelDisplay", "ModelDisplay", i, color=_COLOURS[(i - 1) % len(_COLOURS)], lineWidth="1",
            representation="1", lighting="false", visibility=visible, scalarVisibility="false",
        )  # fmt: skip
        yield from _stored(
            "LinearTransform", "LinearTransform", i, f"{name} first frame", files.first, "TransformStorage",
            "Transform", {}, has_display=False,
        )  # fmt: skip
    ...
