"""A calibration from two crossing sweeps in the form that is saved, with its notes, figure and verdict."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calibration.images.angulation import Angulation
from calibration.images.report import figure_images, pictures, similarity_curves, similarity_map
from calibration.images.solver import SPECKLED_SIMILARITY, ImageCalibration, Improvement
from calibration.images.stacks import TrackedImages
from speckle3d.core.calibration import Calibration, FramesUsed, Parameter

CURVES_TO, CURVE_POINTS, MAP_POINTS = 6.0, 25, 13
"""Reach of the similarity curves and maps in mm and degrees, and how finely they are drawn."""

WEAK_SCALE = 0.01
"""Relative standard error of an estimated pixel size above which the scanner's own value is better."""

MAPS = (("x", "y"), ("z", "tilt"), ("yaw", "roll"))
_WORSE = 0.02
"""Most that the correlation of held-out frames may fall below that at the start: twice what it varies between
answers from different starts."""


def calibration_from_images(
    result: ImageCalibration, angulation: Angulation, sweeps: tuple[TrackedImages, TrackedImages]
) -> Calibration:
    """Turn an answer into a `Calibration`; the second sweep's frames are numbered after the first's."""
    counts = [len(each.frame_time_s) for each in sweeps]
    first, second = result.frames_used
    pose = result.sensor_from_image
    return Calibration(
        method="images",
        sensor="tracker",
        rotation=pose.rotation,
        translation_mm=np.asarray(pose.translation),
        pixel_mm=result.pixel_mm,
        covariance=result.covariance,
        parameters=_parameters(result),
        rms=1.0 - result.held_out.after,
        rms_unit="",
        condition_number=result.condition_number,
        frames=FramesUsed(
            sum(counts), first + tuple(counts[0] + k for k in second), _uncovered(result, counts)
        ),
        time_offset_s=sweeps[0].time_offset_s,
        verdict=_verdict(result, angulation),
    )


def notes_of(result: ImageCalibration, angulation: Angulation) -> list[str]:
    """Lines for the report that show whether the answer is right."""
    centre = np.sqrt(np.diag(result.covariance_of(result.sweeps.centre_mm)))
    used, held = result.similarity, result.held_out
    kept = sum(map(len, result.frames_held_out))
    return [
        f"correlation of images with the other sweep: {_told(used)}",
        f"of {kept} frames kept out of it for this check: {_told(held)}",
        f"image centre known to {centre[0]:.2f}, {centre[1]:.2f} and {centre[2]:.2f} mm across, along the "
        "beam and out of plane",
        f"sweeps at {angulation.crossing_deg:.0f} degrees, fans of {angulation.fan_deg[0]:.0f} and "
        f"{angulation.fan_deg[1]:.0f}; they share {100 * angulation.overlap[0]:.0f} % and "
        f"{100 * angulation.overlap[1]:.0f} % of their images",
        "what both sweeps have wrong alike, as pixel sizes or a clock offset, shows in none of these",
        f"{result.evaluations} comparisons by {result.method}",
    ]


def _told(gained: Improvement) -> str:
    before = f"{gained.before:.3f}" if np.isfinite(gained.before) else "no overlap"
    return f"{before} before, {gained.after:.3f} after"


def figure_of(
    result: ImageCalibration, angulation: Angulation, sweeps: tuple[TrackedImages, TrackedImages]
) -> Figure:
    """One page: two images beside reslices before and after, similarity curves, what errors would do."""
    shown = []
    for k, (one, other) in enumerate((sweeps, sweeps[::-1])):
        held = result.frames_held_out[k] or result.frames_used[k]
        frame = int(held[len(held) // 2])
        shown.append(pictures(one, other, frame, result.start, result.sensor_from_image))
    title = _verdict(result, angulation)
    about = result.sweeps, result.sensor_from_image
    curves = similarity_curves(*about, CURVES_TO, CURVE_POINTS, result.scales)
    maps = [similarity_map(*about, axes, CURVES_TO, MAP_POINTS, result.scales) for axes in MAPS]
    return figure_images(shown, angulation, curves, maps, title)


def _parameters(result: ImageCalibration) -> tuple[Parameter, ...]:
    """The image's origin in the sensor's frame, and the pixel sizes if they were estimated."""
    turn = result.sensor_from_image.rotation.as_matrix()
    errors = np.sqrt(np.diag(turn @ result.covariance[3:, 3:] @ turn.T))
    rows = [
        Parameter(name, float(value), float(error), "mm")
        for name, value, error in zip("xyz", result.sensor_from_image.translation, errors, strict=True)
    ]
    if (result.scale_errors > 0).any():
        pixels = zip(("s_x", "s_y"), result.pixel_mm, result.pixel_mm * result.scale_errors, strict=True)
        rows += [Parameter(name, float(size), float(error), "mm/pixel") for name, size, error in pixels]
    return tuple(rows)


def _uncovered(result: ImageCalibration, counts: list[int]) -> dict[int, str]:
    """Reasons of frames that were neither used nor held out, by number."""
    reasons: dict[int, str] = {}
    for k, before in enumerate((0, counts[0])):
        known = {*result.frames_used[k], *result.frames_held_out[k]}
        reasons |= {before + n: "no reading of the sensor" for n in range(counts[k]) if n not in known}
    return reasons


def _verdict(result: ImageCalibration, angulation: Angulation) -> str:
    if result.scale_errors.max() > WEAK_SCALE:
        lateral, axial = 100.0 * result.scale_errors
        return (
            f"weak: the pixel sizes are known to {lateral:.0f} and {axial:.0f} %: do without estimating them"
        )
    if not result.converged:
        return "did not converge: a better start or sweeps with more structure are needed"
    gain = result.held_out.after - np.nan_to_num(result.held_out.before)
    if gain < -_WORSE:
        return "doubtful: frames that were not used are less alike than at the start"
    if result.alike < SPECKLED_SIMILARITY:
        return (
            f"doubtful: the sweeps are little alike (correlation {result.alike:.2f}), which may displace the "
            "answer by more than its errors say"
        )
    return angulation.verdict
