"""A sweep for 3D Slicer: a scene of volumes, states of voxels, outlines and poses; a sequence that plays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.colors import to_rgb

from speckle3d.core.arrays import AnyArray, ByteArray, FloatArray
from speckle3d.core.files import PathLike
from speckle3d.core.grid import Region
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import MODES
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.core.text import printable
from speckle3d.core.volume import STATE_SEGMENTS
from speckle3d.imaging.images import PosedImages, image_outline
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.io.fileset import FileSet
from speckle3d.io.plus.transforms import pixel_matrix
from speckle3d.io.plus.write import write_sequence, write_transforms
from speckle3d.io.shapes import write_polylines, write_transform
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.figures import colour_of
from speckle3d.study.posed import USUAL_RANGE_DB, PosedSweep
from speckle3d.study.scenes.voxels import VolumeReport, write_voxels

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
_MODES = (*MODES, *REFERENCES)
FILES = FileSet(SCENE, tuple(name.format(mode) for mode in _MODES for name in _NAMES.values()))
"""What a scene may hold."""


def write_scene(
    folder: PathLike,
    posed: Sequence[PosedSweep],
    settings: CompoundingSettings,
    region: Region | None = None,
    with_images: bool = False,
    with_deviation: bool = False,
    progress: Progress | None = None,
) -> list[VolumeReport]:
    """Write a folder with a scene and all that it refers to; it appears whole or not at all.

    Parameters
    ----------
    folder : path
        Made if need be; a scene in it is replaced, other files stay.
    posed : sequence of PosedSweep
        One sweep with the poses of one mode or more.
    settings : CompoundingSettings
    region : Region, optional
        Of the images; samples outside it do not count.
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
    target = Path(folder)
    choices = {"deviation": with_deviation, "images": with_images, "poses": with_images}
    kinds = [kind for kind in _NAMES if choices.get(kind, True)]
    names = dict.fromkeys(_NAMES[kind].format(posed_sweep.mode) for posed_sweep in posed for kind in kinds)
    old_names = {*FILES.others} - {*names}
    scene: list[dict[str, Any]] = []
    reports = []
    with FileSet(SCENE, tuple(names), tuple(old_names)).replaced(target) as part:
        for posed_sweep in posed:
            files = {kind: _NAMES[kind].format(posed_sweep.mode) for kind in kinds}
            paths = {kind: part / name for kind, name in files.items()}
            report = _write_mode(paths, posed_sweep, settings, region)
            reports.append(replace(report, path=target / report.path.name))
            seconds = max(float(np.ptp(posed_sweep.sweep.frame_time_s[posed_sweep.frames])), 1e-3)
            scene.append(
                {
                    "name": printable(f"{posed_sweep.sweep.name}, {posed_sweep.mode}"),
                    "files": files,
                    "is_bytes": settings.voxel_type == "uint8",
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


def _write_mode(
    files: Mapping[str, Path], posed: PosedSweep, settings: CompoundingSettings, region: Region | None
) -> VolumeReport:
    volume, state, deviation = files["volume"], files["state"], files.get("deviation")
    report = write_voxels(posed, settings, volume, None, region, state, deviation)
    sweep, poses = slicer_sequence(posed, settings.dynamic_range_db)
    lines = [posed.world_from_image.apply(point) for point in image_outline(posed.sweep.grid)]
    write_polylines(files["outlines"], np.stack(lines, axis=1), posed.frames)
    write_transform(files["first"], posed.world_from_image[0])
    if "images" in files:
        write_sequence(files["images"], sweep, None, True, poses)
        write_transforms(files["poses"], sweep.frame_time_s, poses)
    return report


_RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class _Bytes:
    """Grey images, 0 to 255, rounded as they are asked for."""

    source: PosedImages
    dtype = np.dtype(np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.source), self.source.grid.vectors, self.source.grid.samples

    def __getitem__(self, index: int) -> ByteArray:
        image: AnyArray = self.source.read(index)
        # Outside a fan there is nothing.
        return np.asarray(np.clip(np.rint(np.nan_to_num(image)), 0, 255), dtype=np.uint8)


def slicer_sequence(
    posed: PosedSweep, dynamic_range_db: float = USUAL_RANGE_DB
) -> tuple[Sweep, dict[str, FloatArray]]:
    """Take a posed sweep's images, B-mode as stored and echoes log-compressed, and where their pixels are.

    Parameters
    ----------
    posed : PosedSweep
    dynamic_range_db : float
        Range of the log-compressed grey levels.

    Returns
    -------
    sweep : Sweep
        Of B-mode, read one at a time.
    poses : dict of str to ndarray, shape (n, 4, 4)
        ``ImageToWorld``, for `write_sequence`: from pixels (column, row, 0, 1) to mm. Unlike in other files
        of this package, axes lead right, anterior and superior, as Slicer takes them: a sequence cannot say
        where its axes lead.
    """
    source, _ = posed.source(None, dynamic_range_db)
    grid, signal = source.grid, posed.sweep.signal
    signal = signal if isinstance(signal, BModeSettings) else BModeSettings(dynamic_range_db)
    times, name = posed.sweep.frame_time_s[posed.frames], posed.sweep.name
    sweep = Sweep(_Bytes(source), grid, signal, times, name=name, probe=posed.sweep.probe)
    lps_from_pixels = posed.world_from_image.as_matrix() @ pixel_matrix(grid)
    return sweep, {"ImageToWorld": _RAS_FROM_LPS @ lps_from_pixels}
