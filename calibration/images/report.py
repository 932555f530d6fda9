"""A calibration from two crossing sweeps in the form that is saved, with its notes, figure and verdict.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging 6920, 2008.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.images.solver import SPECKLED_SIMILARITY, ImageCalibration
from calibration.points import Recording
from speckle3d.core.calibration import Calibration, FramesUsed, Parameter
from speckle3d.imaging.cuts.planes import image_plane
from speckle3d.imaging.cuts.reslice import reslice_at
from speckle3d.imaging.images import ChosenImages

PIXEL_MM = 0.15
_UNSEEN = "#33415c"
"""Where the other sweep has no frame: blue-grey, as in cuts."""
_REACH_MM = 1.5


def calibration_from_images(result: ImageCalibration, sweeps: tuple[Recording, Recording]) -> Calibration:
    """Turn an answer into a `Calibration`; the second sweep's frames are numbered after the first's."""
    counts = [len(sweep.frame_time_s) for sweep in sweeps]
    first, second = result.sweeps.frames
    pose, numbers = result.sensor_from_image, (*first.tolist(), *(counts[0] + second).tolist())
    unread = np.setdiff1d(np.arange(sum(counts)), numbers)
    return Calibration(
        method="images",
        sensor="tracker",
        rotation=pose.rotation,
        translation_mm=pose.translation,
        pixel_mm=result.pixel_mm,
        covariance=result.covariance,
        parameters=_parameters(result),
        rms=1.0 - result.after,
        rms_unit="",
        condition_number=result.condition_number,
        frames=FramesUsed(sum(counts), numbers, dict.fromkeys(unread.tolist(), "no reading of the sensor")),
        time_offset_s=sweeps[0].time_offset_s,
        verdict=_verdict(result),
    )


def notes_of(result: ImageCalibration) -> list[str]:
    """Lines for the report that show whether the answer is right."""
    centre = np.sqrt(np.diag(result.covariance_of(result.sweeps.centre_mm)))
    angles, settings = result.angulation, result.settings
    before = f"{result.before:.3f}" if np.isfinite(result.before) else "no overlap"
    return [
        f"correlation of patches with the other sweep: {before} before, {result.after:.3f} after",
        f"image centre known to {centre[0]:.2f}, {centre[1]:.2f} and {centre[2]:.2f} mm across, along the "
        "beam and out of plane",
        f"the sweeps cross at {angles.crossing_deg:.0f} degrees and fan by {angles.fan_deg[0]:.0f} and "
        f"{angles.fan_deg[1]:.0f} degrees",
        "errors that both sweeps share, of the pixel size or the clock, show in none of these numbers",
        f"claimed errors allow for a tracker that displaces one sweep against the other by "
        f"{settings.tracker_mm:g} mm and {settings.tracker_deg:g} degrees",
    ]


def figure_of(result: ImageCalibration, sweeps: tuple[Recording, Recording]) -> Figure:
    """One page: an image of each sweep beside what the other shows in its place, before and after."""
    figure = Figure(figsize=(12.0, 8.0), layout="constrained")
    panels = figure.subplots(2, 3)
    for row, frames, pair in zip(panels, result.sweeps.frames, (sweeps, sweeps[::-1]), strict=True):
        _draw_images(row, result, *pair, int(frames[len(frames) // 2]))
    figure.suptitle(f"verdict: {_verdict(result)}", fontsize=10)
    return figure


def _draw_images(
    row: Sequence[Axes], result: ImageCalibration, sweep: Recording, crossing: Recording, frame: int
) -> None:
    """An image, and what the other sweep shows in its place at the start and at the answer."""
    image, grid = np.asarray(sweep.images[frame]).T, sweep.grid
    grey = image[np.isfinite(image)]
    low, high = np.percentile(grey, [2.0, 99.5]) if grey.size else (0.0, 1.0)
    extent = (0.0, grid.width_mm, grid.depth_mm - grid.first_sample_depth_mm, 0.0)
    frames = crossing.covered()
    sensors, sensor = crossing.world_from_sensor(frames), sweep.world_from_sensor(np.array([frame]))[0]
    cuts = []
    for pose in (result.start, result.sensor_from_image):
        poses = sensors * pose
        # A little more than the distance between frames deep in a fan.
        steps = np.linalg.norm(np.diff(poses.apply([0.0, 40.0, 0.0]), axis=0), axis=1)
        reach = max(_REACH_MM, 1.5 * float(np.percentile(steps, 98)))
        plane = image_plane(sensor * pose, grid, PIXEL_MM)
        cuts += reslice_at(ChosenImages(crossing.images, frames), crossing.grid, [(poses, plane)], reach)
    beside = (f"the other sweep there, {when} (blue-grey: no frame)" for when in ("before", "after"))
    titles = [f"{sweep.name}, frame {frame}", *beside]
    for axes, title, picture in zip(row, titles, (image, *cuts), strict=True):
        axes.set_facecolor(_UNSEEN)
        axes.imshow(picture, cmap="gray", vmin=low, vmax=high, extent=extent)
        axes.set_title(title, fontsize=8)
        axes.set(xlabel="lateral / mm", ylabel="depth / mm")


def _parameters(result: ImageCalibration) -> tuple[Parameter, ...]:
    """The image's origin in the sensor's frame."""
    turn = result.sensor_from_image.rotation.as_matrix()
    errors = np.sqrt(np.diag(turn @ result.covariance[3:, 3:] @ turn.T))
    return tuple(
        Parameter(name, float(value), float(error), "mm")
        for name, value, error in zip("xyz", result.sensor_from_image.translation, errors, strict=True)
    )


def _verdict(result: ImageCalibration) -> str:
    if result.alike < SPECKLED_SIMILARITY:
        return (
            f"doubtful: the sweeps are little alike (correlation {result.alike:.2f}), which may displace the "
            "answer by more than its errors say"
        )
    return result.angulation.verdict
