"""A folder that opens in 3D Slicer as one scene: volumes, states of voxels, frames' outlines and poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.labels import STATE_SEGMENTS
from speckle3d.core.progress import Progress
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.io.fileset import FileSet
from speckle3d.io.shapes.polylines import write_polylines
from speckle3d.io.shapes.transforms import write_transform
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.posed import PosedSweep
from speckle3d.study.scenes.mrml import COLOURED, Scene
from speckle3d.study.scenes.sequences import PosedSequence
from speckle3d.study.scenes.voxels import (
    BEST_FIRST,
    GridRequest,
    VolumeReport,
    VolumeRequest,
    write_voxels,
)

SCENE = "scene.mrml"

_COLOURS = (
    (0.2, 0.6, 1.0), (1.0, 0.5, 0.1), (0.3, 0.8, 0.3), (0.9, 0.3, 0.3), (0.6, 0.4, 0.9), (0.6, 0.5, 0.3),
)  # fmt: skip
"""Of the outlines of one mode after the other."""


@dataclass(frozen=True)
class SceneRequest:
    """What a scene is to hold.

    Attributes
    ----------
    settings : CompoundingSettings
    grid : GridRequest
    with_images : bool
        Whether the images are there, too, and move through the volume when they are played.
    with_deviation : bool
        Whether each voxel's standard deviation of position is a volume, too.
    """

    settings: CompoundingSettings = field(default_factory=CompoundingSettings)
    grid: GridRequest = field(default_factory=GridRequest)
    with_images: bool = False
    with_deviation: bool = False


@dataclass(frozen=True)
class _Files:
    """Names of the files of one mode."""

    volume: str
    state: str
    outlines: str
    first: str
    deviation: str
    images: str
    poses: str

    @classmethod
    def of(cls, mode: str) -> _Files:
        names = (
            "volume-{}.nrrd", "state-{}.seg.nrrd", "outlines-{}.vtk", "first-frame-{}.tfm",
            "deviation-{}.nrrd", "images-{}.seq.nrrd", "poses-{}.seq.mha",
        )  # fmt: skip
        return cls(*(name.format(mode) for name in names))

    def written(self, request: SceneRequest) -> list[str]:
        deviation = [self.deviation] if request.with_deviation else []
        images = [self.images, self.poses] if request.with_images else []
        return [self.volume, self.state, self.outlines, self.first, *deviation, *images]


def write_scene(
    folder: PathLike,
    posed: Sequence[PosedSweep],
    request: SceneRequest | None = None,
    progress: Progress | None = None,
) -> list[VolumeReport]:
    """Write a folder with a scene and all that it refers to; it appears whole or not at all.

    Parameters
    ----------
    folder : path
        New, or one that holds a scene, which is replaced.
    posed : sequence of PosedSweep
        One sweep with the poses of one mode or more.
    request : SceneRequest, optional
    progress : callable, optional
        Called with the number of planes compounded and their total, of all modes.

    Returns
    -------
    list of VolumeReport
        Of each mode.

    Raises
    ------
    InvalidInputError
        If there is no mode, or one twice.
    FileError
        If the folder cannot be written.
    """
    asked = request or SceneRequest()
    modes = [each.mode for each in posed]
    if not modes or len({*modes}) != len(modes):
        raise InvalidInputError(f"{folder}: expected one mode or more, each once, got {', '.join(modes)}")
    target = Path(folder)
    names = [name for mode in modes for name in _Files.of(mode).written(asked)]
    with FileSet(SCENE, tuple(names), _left(target, names)).replaced(target) as part:
        scene, reports, volumes = Scene(), list[VolumeReport](), list[str]()
        for i, each in enumerate(posed):
            shown = _part_of(progress, i, len(posed))
            report = _write_mode(part, each, asked, shown)
            reports.append(replace(report, path=target / report.path.name))
            volumes.append(_add_mode(scene, each, asked, i))
        scene.show(volumes[0])
        (part / SCENE).write_text(scene.text(), encoding="utf-8")
    return reports


def require_scene_place(folder: Path, *inputs: Path | None) -> None:
    """Refuse to write a scene into a folder that holds an input, or other things than a scene.

    Raises
    ------
    InvalidInputError
        Naming the folder.
    """
    if not folder.is_dir():
        return
    if any(each is not None and each.resolve().parent == folder.resolve() for each in inputs):
        raise InvalidInputError(f"{folder}: holds an input: give another name")
    if any(folder.iterdir()) and not (folder / SCENE).is_file():
        raise InvalidInputError(f"{folder}: expected a new name or a scene to replace, got another folder")


def _left(folder: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Files of a scene in the folder that the new one does not have."""
    if not (folder / SCENE).is_file():
        return ()
    known = {name for mode in (*BEST_FIRST, *REFERENCES) for name in vars(_Files.of(mode)).values()}
    return tuple(sorted(name for name in known - {*names} if (folder / name).exists()))


def _part_of(progress: Progress | None, i: int, count: int) -> Progress | None:
    """Progress of one mode as a part of that of all."""
    if progress is None:
        return None
    return lambda done, total: progress(i * total + done, count * total)


def _write_mode(
    folder: Path, posed: PosedSweep, request: SceneRequest, progress: Progress | None
) -> VolumeReport:
    files = _Files.of(posed.mode)
    deviation = folder / files.deviation if request.with_deviation else None
    voxels = VolumeRequest(
        folder / files.volume, request.settings, request.grid, None, folder / files.state, deviation
    )
    report = write_voxels(posed, voxels, progress)
    sequence = PosedSequence.of(posed, request.settings.dynamic_range_db)
    outlines = frame_outlines(sequence.sweep.grid, posed.world_from_image)
    write_polylines(folder / files.outlines, outlines, {"frame": posed.frames.astype(np.float64)})
    write_transform(folder / files.first, posed.world_from_image[0])
    if request.with_images:
        sequence.write(folder / files.images)
        sequence.write_poses(folder / files.poses)
    return report


def _add_mode(scene: Scene, posed: PosedSweep, request: SceneRequest, i: int) -> str:
    """Add a mode's nodes; returns the identity of its volume."""
    files, name = _Files.of(posed.mode), f"{posed.sweep.name}, {posed.mode}"
    window = (0.0, 255.0) if request.settings.voxel_type == "uint8" else None
    volume = scene.add_volume(name, files.volume, window)
    scene.add_labels(f"{name}: voxels", files.state, volume, STATE_SEGMENTS)
    if request.with_deviation:
        said = f"{name}: standard deviation of position along the sweep, mm"
        scene.add_volume(said, files.deviation, None, COLOURED)
    scene.add_lines(f"{name}: outlines", files.outlines, _COLOURS[i % len(_COLOURS)], visible=i == 0)
    scene.add_transform(f"{name}: first frame", files.first)
    if request.with_images:
        rate = len(posed.frames) / max(float(np.ptp(posed.sweep.frame_time_s[posed.frames])), 1e-3)
        scene.add_moving_images(f"{name}: frames", files.images, files.poses, rate)
    return volume
