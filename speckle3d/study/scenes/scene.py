"""A folder that opens in 3D Slicer as one scene: volumes, states of voxels, frames' outlines and poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.colors import to_rgb

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.core.labels import STATE_SEGMENTS
from speckle3d.core.printable import printable
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import MODES
from speckle3d.core.region import Region
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.io.fileset import FileSet
from speckle3d.io.plus.write import write_sequence, write_transforms
from speckle3d.io.shapes.surfaces import write_polylines
from speckle3d.io.shapes.transforms import write_transform
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.figures import colour_of
from speckle3d.study.posed import PosedSweep
from speckle3d.study.scenes.sequences import slicer_sequence
from speckle3d.study.scenes.voxels import (
    GridRequest,
    VolumeReport,
    VolumeRequest,
    write_voxels,
)

SCENE = "scene.mrml"

_TEMPLATE = Path(__file__).with_name(SCENE)
_NAMES = {
    "volume": "volume-{}.nrrd",
    "state": "state-{}.seg.nrrd",
    "outlines": "outlines-{}.vtk",
    "first": "first-frame-{}.tfm",
    "deviation": "deviation-{}.nrrd",
    "images": "images-{}.seq.nrrd",
    "poses": "poses-{}.seq.mha",
}
"""Files of a mode, by what they hold."""


@dataclass(frozen=True)
class SceneRequest:
    """What a scene is to hold.

    Attributes
    ----------
    settings : CompoundingSettings
    grid : GridRequest
    region : Region, optional
        Of the images; samples outside it do not count in the volumes.
    with_images : bool
        Whether the images are there, too, and move through the volume when they are played.
    with_deviation : bool
        Whether each voxel's standard deviation of position is a volume, too.
    """

    settings: CompoundingSettings = field(default_factory=CompoundingSettings)
    grid: GridRequest = field(default_factory=GridRequest)
    region: Region | None = None
    with_images: bool = False
    with_deviation: bool = False

    def files(self, mode: str) -> dict[str, str]:
        """Names of a mode's files that are written."""
        wanted = {"deviation": self.with_deviation, "images": self.with_images, "poses": self.with_images}
        return {what: name.format(mode) for what, name in _NAMES.items() if wanted.get(what, True)}


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
        Called with the number of modes done and of all.

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
    names = [name for mode in modes for name in asked.files(mode).values()]
    reports = []
    with FileSet(SCENE, tuple(names), _stale(target, names)).replaced(target) as part:
        for each in posed:
            report = _write_mode(part, each, asked)
            reports.append(replace(report, path=target / report.path.name))
            if progress is not None:
                progress(len(reports), len(posed))
        (part / SCENE).write_text(_scene_text(posed, asked), encoding="utf-8")
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


def _stale(folder: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Files of a scene in the folder that the new one does not have."""
    if not (folder / SCENE).is_file():
        return ()
    ours = {name.format(mode) for mode in (*MODES, *REFERENCES) for name in _NAMES.values()}
    return tuple(sorted(name for name in ours - {*names} if (folder / name).exists()))


def _write_mode(folder: Path, posed: PosedSweep, request: SceneRequest) -> VolumeReport:
    files = {what: folder / name for what, name in request.files(posed.mode).items()}
    voxels = VolumeRequest(
        files["volume"],
        request.settings,
        request.grid,
        request.region,
        files["state"],
        files.get("deviation"),
    )
    report = write_voxels(posed, voxels)
    sweep, poses = slicer_sequence(posed, request.settings.dynamic_range_db)
    outlines = frame_outlines(sweep.grid, posed.world_from_image)
    write_polylines(files["outlines"], outlines, {"frame": posed.frames.astype(np.float64)})
    write_transform(files["first"], posed.world_from_image[0])
    if request.with_images:
        write_sequence(files["images"], sweep, None, True, poses)
        write_transforms(files["poses"], sweep.frame_time_s, poses)
    return report


def _scene_text(posed: Sequence[PosedSweep], request: SceneRequest) -> str:
    """Scene as XML; everything that comes from outside is escaped."""
    modes: list[dict[str, Any]] = []
    for each in posed:
        seconds = max(float(np.ptp(each.sweep.frame_time_s[each.frames])), 1e-3)
        modes.append(
            {
                "name": printable(f"{each.sweep.name}, {each.mode}"),
                "files": request.files(each.mode),
                "is_bytes": request.settings.voxel_type == "uint8",
                "colour": " ".join(f"{part:.3g}" for part in to_rgb(colour_of(each.mode))),
                "frames_per_s": f"{len(each.frames) / seconds:g}",
            }
        )
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(modes=modes, segments=", ".join(each.name for each in STATE_SEGMENTS))
