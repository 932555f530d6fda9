"""A folder that opens in 3D Slicer as one scene: volumes, states of voxels, frames' outlines and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.io.fileset import FileSet
from speckle3d.io.plus.write import write_sequence, write_transforms
from speckle3d.io.shapes import write_polylines, write_transform
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.figures import colour_of
from speckle3d.study.posed import PosedSweep
from speckle3d.study.scenes.sequences import slicer_sequence
from speckle3d.study.scenes.voxels import VolumeReport, VolumeRequest, write_voxels

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


def write_scene(
    folder: PathLike,
    posed: Sequence[PosedSweep],
    request: VolumeRequest | None = None,
    with_images: bool = False,
    with_deviation: bool = False,
    progress: Progress | None = None,
) -> list[VolumeReport]:
    """Write a folder with a scene and all that it refers to; it appears whole or not at all.

    Parameters
    ----------
    folder : path
        New, or one that holds a scene, which is replaced.
    posed : sequence of PosedSweep
        One sweep with the poses of one mode or more.
    request : VolumeRequest, optional
    with_images : bool
        Whether the images are there, too, and move through the volume when they are played.
    with_deviation : bool
        Whether each voxel's standard deviation of position is a volume, too.
    progress : callable, optional
        Called with the number of modes done and of all.

    Returns
    -------
    list of VolumeReport
        Of each mode.

    Raises
    ------
    FileError
        If the folder cannot be written.
    """
    request, target = request or VolumeRequest(), Path(folder)
    choices = {"deviation": with_deviation, "images": with_images, "poses": with_images}
    kinds = [kind for kind in _NAMES if choices.get(kind, True)]
    names = dict.fromkeys(_NAMES[kind].format(posed_sweep.mode) for posed_sweep in posed for kind in kinds)
    old_names = {name.format(mode) for mode in (*MODES, *REFERENCES) for name in _NAMES.values()} - {*names}
    scene: list[dict[str, Any]] = []
    reports = []
    with FileSet(SCENE, tuple(names), tuple(old_names)).replaced(target) as part:
        for posed_sweep in posed:
            files = {kind: _NAMES[kind].format(posed_sweep.mode) for kind in kinds}
            report = _write_mode({kind: part / name for kind, name in files.items()}, posed_sweep, request)
            reports.append(replace(report, path=target / report.path.name))
            seconds = max(float(np.ptp(posed_sweep.sweep.frame_time_s[posed_sweep.frames])), 1e-3)
            scene.append(
                {
                    "name": printable(f"{posed_sweep.sweep.name}, {posed_sweep.mode}"),
                    "files": files,
                    "is_bytes": request.settings.voxel_type == "uint8",
                    "colour": " ".join(f"{share:.3g}" for share in to_rgb(colour_of(posed_sweep.mode))),
                    "frames_per_s": f"{len(posed_sweep.frames) / seconds:g}",
                }
            )
            if progress is not None:
                progress(len(reports), len(posed))
        # Everything that comes from outside is escaped.
        environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
        template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
        segments = ", ".join(segment.name for segment in STATE_SEGMENTS)
        (part / SCENE).write_text(template.render(modes=scene, segments=segments), encoding="utf-8")
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
    if any(path is not None and path.resolve().parent == folder.resolve() for path in inputs):
        raise InvalidInputError(f"{folder}: holds an input: give another name")
    if any(folder.iterdir()) and not (folder / SCENE).is_file():
        raise InvalidInputError(f"{folder}: expected a new name or a scene to replace, got another folder")


def _write_mode(files: Mapping[str, Path], posed: PosedSweep, request: VolumeRequest) -> VolumeReport:
    report = write_voxels(posed, request, files["volume"], files["state"], files.get("deviation"))
    sweep, poses = slicer_sequence(posed, request.settings.dynamic_range_db)
    outlines = frame_outlines(sweep.grid, posed.world_from_image)
    write_polylines(files["outlines"], outlines, posed.frames)
    write_transform(files["first"], posed.world_from_image[0])
    if "images" in files:
        write_sequence(files["images"], sweep, None, True, poses)
        write_transforms(files["poses"], sweep.frame_time_s, poses)
    return report
