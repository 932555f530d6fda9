"""Mode ``fused``: images, orientation sensor, tracker and evidence of the scale in one least-squares problem.

Unknown are the pose of every frame, the errors that the images' steps share, and of every sensor its world,
mounting, clock, millimetres and wandering error. The images' steps enter with their full covariance, grown
because pairs of frames share speckle, and may all be wrong by one scale and one rate of tilt and of yaw,
and by a little more that changes along the sweep. The sizes of the errors are found from the data.

References
----------
.. [1] F. Dellaert and M. Kaess, "Factor graphs for robot perception", Foundations and Trends in Robotics 6,
   2017.
.. [2] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
   Biometrika 58, 1971 (restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.relative import RelativePoses
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.correction.fused.contradictions import Contradiction, contradictions, difference
from speckle3d.correction.fused.images import ImageEvidence
from speckle3d.correction.fused.sensors import SensorEvidence, SensorLimits, read_sensor
from speckle3d.correction.fused.settings import FusedSettings
from speckle3d.correction.fused.sides import on_felt_sides, on_sensed_sides
from speckle3d.correction.fused.sizes import Wander
from speckle3d.correction.fused.solution import Problem, Solution
from speckle3d.correction.scale import FusedPoses, ScaleEvidence
from speckle3d.correction.trust import ORIENTATION, TRACKER

UNUSED = 1e-9
"""Standard deviation of what a sensor does not have: an orientation sensor's millimetres."""
LEAST_PATH_MM = 0.1
"""Travel by the images that a scale is given of at least."""


def fuse(
    edges: RelativePoses,
    image: RigidTransform,
    image_covariance: FloatArray,
    scale_sigma: float,
    turn_sigma_per_mm: FloatArray,
    centre_mm: FloatArray,
    frame_time_s: FloatArray,
    orientation: OrientationSensor | None = None,
    tracker: Tracker | None = None,
    evidence: Sequence[ScaleEvidence] = (),
    felt_back: BoolArray | None = None,
    settings: FusedSettings | None = None,
) -> FusedPoses:
    """Find poses from all that is known of a sweep.

    Parameters
    ----------
    edges : RelativePoses
        Frame pairs, with covariances as if pairs were independent of each other.
    image : RigidTransform, length n
        Image-based poses that were solved from `edges`.
    image_covariance : ndarray, shape (n, 6, 6)
        Claimed for `image`: of (x, y, z, tilt, yaw, roll), mm and rad.
    scale_sigma : float
        Relative standard deviation of the scale that all edges share, mismatch of the curves included.
    turn_sigma_per_mm : ndarray, shape (2,)
        Standard deviations of yaw and of tilt per mm that the images lack.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    frame_time_s : ndarray, shape (n,)
    orientation : OrientationSensor, optional
    tracker : Tracker, optional
        Sensors without a mounting, or with too few readings over the frames, are left out.
    evidence : sequence of ScaleEvidence
        What a crossing sweep or an accelerometer says of the scale.
    felt_back : ndarray of bool, shape (n - 1,), optional
        Steps from each frame to the next that an accelerometer feels to go the other way than the images
        have them; what it says of the scale is of steps so turned.
    settings : FusedSettings, optional

    Returns
    -------
    FusedPoses
        In the world of the tracker, or else of the orientation sensor with its origin at the first frame's
        image origin, or else of the first frame.
    """
    settings = settings or FusedSettings()
    yaw, tilt = turn_sigma_per_mm
    centre = RigidTransform.from_translation(centre_mm)
    start = centre.inv() * (image[0].inv() * image) * centre
    seen_mm = _along(start)
    if felt_back is not None:
        edges, start = on_felt_sides(edges, start, felt_back)
    if tracker is not None:
        read = read_sensor(tracker, TRACKER, start, centre_mm, frame_time_s, _limits(settings, TRACKER))
        edges, start = on_sensed_sides(edges, start, read) if read else (edges, start)
    images = ImageEvidence.of(edges, start, image_covariance, scale_sigma, np.array([tilt, yaw]))
    sensors = _sensors(start, centre_mm, frame_time_s, orientation, tracker, settings)
    solution, problem = Problem.of(images, sensors, evidence).solve()
    contrary = contradictions(problem, solution, settings.contradiction_sigma)
    return _reported(problem, solution, contrary, centre, seen_mm)


def _limits(settings: FusedSettings, name: str) -> SensorLimits:
    stretch = settings.tracker_scale_sigma if name == TRACKER else UNUSED
    return SensorLimits(
        settings.mounting_sigma_rad, settings.mounting_sigma_mm, settings.clock_sigma_s, stretch
    )


def _sensors(
    start: RigidTransform,
    centre_mm: FloatArray,
    frame_time_s: FloatArray,
    orientation: OrientationSensor | None,
    tracker: Tracker | None,
    settings: FusedSettings,
) -> list[tuple[SensorEvidence, Wander | None]]:
    """The sensors that can be used, and what each is expected to wander by."""
    inclination, heading = settings.inclination_sigma_rad, settings.heading_sigma_rad
    slow = Wander(np.array([inclination, inclination, heading]), settings.wander_s)
    found: list[tuple[SensorEvidence, Wander | None]] = []
    for sensor, name, expected in ((tracker, TRACKER, None), (orientation, ORIENTATION, slow)):
        if sensor is not None:
            read = read_sensor(sensor, name, start, centre_mm, frame_time_s, _limits(settings, name))
            found += [(read, expected)] if read else []
    return found


def _reported(
    problem: Problem,
    solution: Solution,
    contrary: Sequence[Contradiction],
    centre: RigidTransform,
    seen_mm: FloatArray,
) -> FusedPoses:
    images, state = solution.images, solution.state
    frames, weight = images.parts
    path = float(weight @ _along(state.poses)[frames])
    variance = float(weight @ solution.covariance(frames)[2::6, 2::6] @ weight)
    covariance = solution.marginals()
    for each in contrary:
        # Either may be right: the claim reaches from the one to the other.
        apart = np.zeros((len(images), 6))
        apart[:, each.parts] = difference(images.start, state.poses)[:, each.parts]
        covariance += apart[:, :, None] * apart[:, None, :]
        variance += (path - images.path_mm) ** 2 if 2 in each.parts else 0.0
    world = RigidTransform.identity()
    if problem.sensors:
        world = state.sensors[0].world * centre.inv()
        if problem.sensors[0].components == 3:
            world = RigidTransform.from_rotation(state.sensors[0].world.rotation)
    sizes = _sizes(problem, solution)
    details: dict[str, float | str] = {"used": ", ".join(problem.names), **sizes}
    if not np.array_equal(seen_mm, images.along_mm):
        details["stretches"] = "turned over where the tracker saw the probe go the other way"
    return FusedPoses(
        poses=world * centre * state.poses * centre.inv(),
        covariance=covariance,
        log_scale=float(np.log(path / max(abs(float(weight @ seen_mm[frames])), LEAST_PATH_MM))),
        log_scale_sigma=float(np.sqrt(variance)) / path,
        evidence=problem.evidence,
        details=details | _directions(problem, solution),
        used=problem.names,
        contradictions=tuple(each.doubt for each in contrary),
        sizes=sizes,
    )


def _directions(problem: Problem, solution: Solution) -> dict[str, float | str]:
    """How the scales there and back compare, if the sweep comes back over what it has seen."""
    images = solution.images
    frames, _ = images.parts
    if frames.size < 2 or not images.returns.any():
        return {}
    z_mm, seen = _along(solution.state.poses)[frames], images.along_mm[frames]
    there, back = z_mm[0], z_mm[0] - z_mm[1]
    slope = np.array([1.0 / there - 1.0 / back, 1.0 / back])
    sigma = float(np.sqrt(slope @ solution.covariance(frames)[2::6, 2::6] @ slope))
    ratio = float(there / back * (seen[0] - seen[1]) / seen[0])
    told = [name for name in problem.names if name not in ("images", ORIENTATION)]
    said = "set by " + " and ".join(told) if told else "unknown beyond what the images claim"
    tied = f"forward and back are tied to each other; their common scale is {said}"
    return {"directions": tied, "direction_ratio": ratio, "direction_ratio_sigma": sigma}


def _along(poses: RigidTransform) -> FloatArray:
    steps = (poses[:-1].inv() * poses[1:]).translation[:, 2]
    return np.concatenate([[0.0], np.cumsum(steps)])


def _sizes(problem: Problem, solution: Solution) -> dict[str, float]:
    sizes: dict[str, float] = {}
    for sensor, wander in zip(problem.sensors, solution.sizes.wander, strict=True):
        degrees, millimetres = float(np.degrees(sensor.jitter[0])), float(sensor.jitter[1])
        if sensor.components == 6:
            sizes |= {"tracker_jitter_mm": millimetres, "tracker_jitter_deg": degrees}
            sizes |= {"tracker_wander_mm": float(wander.sigma[3])}
        else:
            inclination, _, heading = np.degrees(wander.sigma)
            sizes |= {"orientation_jitter_deg": degrees}
            sizes |= {"inclination_wander_deg": float(inclination), "heading_wander_deg": float(heading)}
    if problem.sensors:
        common, changing = solution.sizes.images.common, solution.sizes.images.changing
        sizes |= {"image_turn_factor": float(common[1]), "image_turn_change_factor": float(changing[1])}
        sizes |= {"image_scale_change_factor": float(changing[0])}
    return sizes
