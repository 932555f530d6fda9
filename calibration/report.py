"""Report of a calibration: text, JSON and figure, and the form that is saved."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calibration.beam import BeamBias
from calibration.points import CHAIN, SCALES, Detections, Recording
from calibration.solution import Solution
from speckle3d.core.calibration import Calibration, FramesUsed, Parameter
from speckle3d.core.geometry import roll_yaw_tilt, skew
from speckle3d.core.text import text_rows

USED_COLOUR, DROPPED_COLOUR = "#0072B2", "#D55E00"
"""Colours of Okabe and Ito's palette, distinguishable with any colour vision."""

IMAGE_POSE = ("gamma", "beta", "alpha", "x", "y", "z")
"""Tilt, yaw, roll and displacements: small angles in frames that lie on the image."""

_MOST_ROWS = 20


def as_calibration(
    solution: Solution, method: str, frames: FramesUsed, time_offset_s: float | None = None
) -> Calibration:
    """Bring a solution into the form that is saved, with standard errors of the published parameters.

    Parameters
    ----------
    frames : FramesUsed
        With the frames in which nothing was found or that no sensor reading covers. Those that the solver
        left out are added.
    """
    angular, reasons = solution.angular, dict(frames.dropped)
    for number in np.unique(solution.points.frame[~solution.used]):
        worst = float(np.abs(solution.residuals[solution.points.frame == number]).max())
        size = f"{np.rad2deg(worst):.1f} degrees" if angular else f"{worst:.1f} mm"
        reasons[int(number)] = f"contradicts the other frames by {size}"
    unlike = [number for number, reason in reasons.items() if "the other frames" in reason]
    numbers = np.union1d(solution.points.frames, unlike)
    # A tenth: fewer frames may be of a probe that was lifted.
    moved = np.isin(numbers[-(numbers.size // 10) :], unlike).mean() > 0.5
    chain, pose = solution.chain, IMAGE_POSE[:3] if angular else IMAGE_POSE
    return Calibration(
        method=method,
        sensor="orientation" if angular else "tracker",
        rotation=chain.sensor_from_image.rotation,
        translation_mm=None if angular else chain.sensor_from_image.translation,
        pixel_mm=None if angular else chain.pixel_mm,
        covariance=solution.image_covariance(pose),
        parameters=_parameters(solution),
        rms=solution.rms,
        rms_unit="rad" if angular else "mm",
        condition_number=solution.condition_number,
        frames=FramesUsed(frames.given, tuple(solution.points_used.frames.tolist()), reasons),
        time_offset_s=time_offset_s,
        verdict=solution.adequacy.verdict
        + "; most of the last frames contradict the others: did sensor or phantom move?" * bool(moved),
    )


def _parameters(solution: Solution) -> tuple[Parameter, ...]:
    """The parameters estimated: places in the sensor's frame and the phantom's, angles about own axes.

    An angle's error is that about the image's z, y and x axes (roll, yaw, tilt), or about the phantom's:
    near a singularity of fixed angles it is as large as ever.
    """
    poses = solution.chain.sensor_from_image, solution.chain.target_from_world
    parts = [part for pose in poses for part in (pose.translation, roll_yaw_tilt(pose.rotation))]
    values = dict(zip(CHAIN, np.concatenate([solution.chain.pixel_mm, *parts]), strict=True))
    turn = np.eye(len(CHAIN))
    turn[2:5, 2:5] = solution.chain.sensor_from_image.rotation.as_matrix()
    # Angles are in the order z, y, x; the world's origin moves as the phantom turns.
    turn[8:11, 13:10:-1] = -skew(solution.chain.target_from_world.translation[None])[0]
    covariance = turn @ solution.full_covariance @ turn.T
    errors = dict(zip(CHAIN, np.sqrt(np.diag(covariance)), strict=True))
    units = {name: "mm/pixel" if name in SCALES else "mm" if name[0] in "xyz" else "rad" for name in CHAIN}
    return tuple(
        Parameter(name, float(values[name]), float(errors[name]), units[name]) for name in solution.free
    )


def text_report(calibration: Calibration, beam: Sequence[BeamBias] = (), notes: Sequence[str] = ()) -> str:
    """Text of the report: table, matrix in PLUS's form, and bias by the beam."""
    lines = text_rows(calibration.rows()).splitlines()
    if outliers := sorted(calibration.frames.dropped.items()):
        lines += ["", "Frames left out:"]
        lines += [f"  {number}: {reason}" for number, reason in outliers[:_MOST_ROWS]]
        if len(outliers) > _MOST_ROWS:
            lines.append(f"  and {len(outliers) - _MOST_ROWS} more, which the calibration file names")
    if calibration.translation_mm is not None and calibration.pixel_mm is not None:
        lines += ["", "ImageToProbe (pixels to mm, as PLUS and 3D Slicer have it):"]
        lines += ["  " + " ".join(f"{value:12.6f}" for value in row) for row in calibration.pixel_matrix()]
    if beam:
        lines += ["", "On a bare wall, lines at the first echo put the image too near to the probe, by"]
        lines += [
            f"  {abs(bias.shift_mm[1]):.2f} mm if the beam is {bias.width_mm:g} mm thick "
            f"(with an RMS residual of {bias.rms_mm:.3f} mm)"
            for bias in beam
        ]
        lines += [
            "Lines at the brightest part of an echo (--place peak) have little of this bias;",
            "a thin bar that stays in the middle of the beam has none.",
        ]
    return "\n".join([*lines, *(["", *notes] if notes else [])]) + "\n"


def json_report(calibration: Calibration, beam: Sequence[BeamBias] = ()) -> dict[str, Any]:
    """Numbers of the report, angles in radians."""
    frames, names = calibration.frames, ("tilt_rad", "yaw_rad", "roll_rad", "x_mm", "y_mm", "z_mm")
    alike = ("method", "sensor", "translation_mm", "pixel_mm", "parameters", "rms", "rms_unit")
    return {
        **{
            name: getattr(calibration, name)
            for name in (*alike, "condition_number", "time_offset_s", "verdict")
        },
        "sensor_from_image_wxyz": calibration.rotation.as_quat(scalar_first=True),
        "standard_errors": np.sqrt(np.diag(calibration.covariance)),
        "standard_errors_of": names[: len(calibration.covariance)],
        "frames_given": frames.given,
        "frames_used": frames.used,
        "frames_dropped": frames.dropped,
        "beam": beam,
    }


def figure_report(
    solution: Solution, calibration: Calibration, recording: Recording, detections: Detections
) -> Figure:
    """One page: images with what was found in them, residuals, and the motion."""
    figure = Figure(figsize=(12.0, 7.5), layout="constrained")
    panels = figure.subplots(2, 3)
    for axes in panels[0]:
        axes.set_axis_off()
    # For an orientation sensor, only the ratio of the pixel sizes is known; no more is needed.
    aspect = float(solution.chain.pixel_mm[1] / solution.chain.pixel_mm[0])
    # A used frame from the middle, one from the end, and the first that was dropped, else the first used.
    frames, reasons = calibration.frames.used, calibration.frames.dropped
    numbers = dict.fromkeys([frames[len(frames) // 2], frames[-1], *sorted(reasons)[:1], frames[0]])
    for axes, number in zip(panels[0], numbers, strict=False):
        image, note = np.asarray(recording.images[number]), reasons.get(number, "")
        marks_px = detections.pixels[detections.frame == number].reshape(-1, 2)
        axes.imshow(image.T, cmap="gray", aspect=aspect)
        colour = DROPPED_COLOUR if note else USED_COLOUR
        if detections.are_lines and len(marks_px):
            axes.axline(*marks_px, color=colour, lw=1.0)
        else:
            axes.plot(*marks_px.T, "o", mfc="none", color=colour, ms=8)
        axes.set(xlim=(0, image.shape[0] - 1), ylim=(image.shape[1] - 1, 0))
        axes.set_title(f"frame {number}" + (f"\n{note[:60]}" if note else ""), fontsize=8)
    worst = np.abs(solution.residuals).argmax(axis=1)
    values = solution.residuals[np.arange(len(worst)), worst]
    values, unit = (np.rad2deg(values), "deg") if solution.angular else (values, "mm")
    turns = solution.chain.target_from_image(solution.points).rotation
    tilt, yaw, roll = np.rad2deg((turns.mean().inv() * turns).as_rotvec()).T
    inliers, (by_frame, by_tilt, motion) = solution.used, panels[1]
    by_frame.plot(solution.points.frame[inliers], values[inliers], ".", color=USED_COLOUR, ms=3)
    by_frame.plot(solution.points.frame[~inliers], values[~inliers], "x", color=DROPPED_COLOUR, ms=4)
    size = float(np.abs(values[inliers]).std() + 1e-12)
    reach = np.clip(1.1 * float(np.abs(values).max()), 8.0 * size, 30.0 * size)
    by_frame.set(xlabel="frame", ylabel=f"largest residual of a point / {unit}", ylim=(-reach, reach))
    # Here a thick beam shows as a V.
    by_tilt.plot(tilt[inliers], values[inliers], ".", color=USED_COLOUR, ms=3)
    by_tilt.set(xlabel="tilt / deg", ylabel=f"largest residual / {unit}")
    dots = motion.scatter(tilt[inliers], roll[inliers], c=yaw[inliers], s=6)
    figure.colorbar(dots, ax=motion, label="yaw / deg")
    motion.set(xlabel="tilt / deg", ylabel="roll / deg")
    motion.set_title("how the probe was turned", fontsize=9)
    for axes in panels[1]:
        axes.grid(alpha=0.3)
    figure.suptitle(fill(calibration.verdict, 150), fontsize=9)
    figure.supxlabel("blue: found in the image, and used; red: left out (residuals: x)", fontsize=8)
    return figure
