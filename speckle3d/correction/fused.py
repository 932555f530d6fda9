"""Mode ``fused``: the images' path, bent by small corrections onto all sensors, in one least-squares problem.

Unknown are corrections of the images' steps (`ImagePath`: a scale and rates of turn for the whole sweep, and
small increments over a few frames each) and, of every sensor, its world, mounting, clock, millimetres and
wander (`SensorReadings`). Corrections are in the images' own millimetres and are all that the images' errors
are: no residual of theirs grows or shrinks with the scale, as it would where edges are compared with poses.

References
----------
.. [1] R. J. Housden et al., BioMedical Engineering OnLine 7:5, 2008, equations 1 to 3 (the corrected chain).
.. [2] P. J. Huber, "Robust statistics", Wiley, 1981 (the loss).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.leastsquares import huber_weights
from speckle3d.core.poses import RelativePoses
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.correction.claims import length_sigma
from speckle3d.correction.image_path import ImagePath
from speckle3d.correction.scale import ScaledPoses, ScaleEvidence
from speckle3d.correction.sensor_readings import SensorReadings
from speckle3d.correction.settings import FusedSettings

MOST_ROUNDS, LEAST_GAIN = 30, 0.01
"""Rounds at most, and the squared step in standard deviations that ends them: a tenth of a claim."""
FARTHEST = 2.0
"""Factor between the lengths of images and tracker beyond which no average of the two means anything."""


@dataclass(frozen=True)
class FusionProblem:
    """Least-squares problem of mode `fused`; unknowns of the path, then of each sensor."""

    path: ImagePath
    sensors: tuple[SensorReadings, ...]
    evidence: ScaleEvidence | None

    @classmethod
    def of(
        cls,
        edges: RelativePoses,
        image: RigidTransform,
        share: float,
        shared: SharedErrors,
        centre_mm: FloatArray,
        frame_time_s: FloatArray,
        orientation: OrientationSensor | None = None,
        tracker: Tracker | None = None,
        evidence: ScaleEvidence | None = None,
        settings: FusedSettings | None = None,
    ) -> FusionProblem:
        """Set up the problem.

        Parameters
        ----------
        edges : RelativePoses
            Frame pairs, with covariances as if pairs were independent of each other.
        image : RigidTransform, length n
            Image-based poses that were solved from `edges`.
        share : float
            Mean share of echoes that stay from frame to frame.
        shared : SharedErrors
            What all distances have wrong together.
        centre_mm : ndarray, shape (3,)
            The image's centre.
        frame_time_s : ndarray, shape (n,)
        orientation : OrientationSensor, optional
        tracker : Tracker, optional
            Sensors without a mounting, or with too few readings over the frames, are left out.
        evidence : ScaleEvidence, optional
            What a crossing sweep says of the scale.
        settings : FusedSettings, optional

        Raises
        ------
        MismatchError
            If images and tracker differ in length by more than a factor of two.
        """
        centre = RigidTransform.from_translation(centre_mm)
        start = centre.inv() * (image[0].inv() * image) * centre
        path = ImagePath.of(edges, start, share, shared, frame_time_s)
        frames = start.as_matrix(), centre_mm, frame_time_s, settings or FusedSettings()
        readings = [SensorReadings.of(sensor, *frames) for sensor in (tracker, orientation)]
        sensors = tuple(sensor for sensor in readings if sensor is not None)
        for sensor in sensors:
            ratio = sensor.travel_ratio(frames[0]) if sensor.places else 1.0
            if not 1.0 / FARTHEST < ratio < FARTHEST:
                raise MismatchError(
                    f"expected a tracker that travels as far as the images, within a factor of {FARTHEST:g}, "
                    f"got {ratio:.3g} times as far: compare modes image and pose"
                )
        return cls(path, sensors, evidence)

    @property
    def columns(self) -> list[slice]:
        """Slices of the unknowns of the path and of each sensor."""
        ends = np.cumsum([self.path.sigma.size, *(sensor.size for sensor in self.sensors)])
        return [slice(int(first), int(last)) for first, last in zip([0, *ends[:-1]], ends, strict=True)]

    def solve(self) -> tuple[FloatArray, FloatArray, FusionProblem]:
        """Best unknowns by Gauss-Newton with Huber's weights, their covariance, and the sensors' wander."""
        problem, unknowns, scale = self, np.zeros(self.columns[-1].stop), self.path.scale
        for _ in range(MOST_ROUNDS):
            matrix, gradient = problem.normal_equations(unknowns)
            covariance = np.asarray(cho_solve(cho_factor(matrix), np.eye(unknowns.size)))
            step = covariance @ gradient
            # Readings far off may pull the length through zero: a step takes half of it at most.
            step *= min(1.0, (1.0 + unknowns[scale]) / 2.0 / max(step[scale], np.finfo(float).tiny))
            unknowns = unknowns - step
            if gradient @ step < LEAST_GAIN:
                break
            parts = zip(self.columns[1:], problem.sensors, strict=True)
            sensors = [sensor.with_wander(unknowns[at], covariance[at, at]) for at, sensor in parts]
            problem = replace(problem, sensors=tuple(sensors))
        return unknowns, covariance, problem

    def normal_equations(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrix and gradient, summed over pieces of the equations."""
        matrix, gradient = np.zeros((unknowns.size, unknowns.size)), np.zeros(unknowns.size)
        for columns, residual, slope, robust in self._equations(unknowns):
            size = np.sqrt((residual**2).mean(axis=1))
            root = np.sqrt(huber_weights(size) if robust else np.ones_like(size))[:, None]
            rows, pull = (slope * root[:, :, None]).reshape(-1, slope.shape[-1]), (residual * root).ravel()
            matrix[np.ix_(columns, columns)] += rows.T @ rows
            gradient[columns] += rows.T @ pull
        return matrix, gradient

    def _equations(self, unknowns: FloatArray) -> Iterator[tuple[IntArray, FloatArray, FloatArray, bool]]:
        """Columns, residuals (k, r), a weight a row, derivatives (k, r, columns), and if the loss is robust.

        It is not for what is known of a sensor: its millimetres would be free.
        """
        every: IntArray = np.arange(unknowns.size)
        on_path = self.columns[0]
        coefficients = unknowns[on_path]
        residual, slope = self.path.prior(coefficients)
        yield every[on_path], residual[:, None], slope[:, None], True
        if self.evidence is not None:
            residual, slope = self.path.misfit(coefficients, self.evidence)
            yield every[on_path], residual[None], slope[None], True
        for sensor, columns in zip(self.sensors, self.columns[1:], strict=True):
            residual, slope = sensor.prior(unknowns[columns])
            yield every[columns], residual[:, None], slope[:, None], False
            joint = np.concatenate([every[on_path], every[columns]])
            for residual, slope in sensor.equations(self.path, coefficients, unknowns[columns]):
                yield joint, residual, slope, True


def fuse(problem: FusionProblem, centre_mm: FloatArray) -> ScaledPoses:
    """Estimate poses from images, sensors and crossing sweep together.

    Parameters
    ----------
    problem : FusionProblem
    centre_mm : ndarray, shape (3,)
        The image's centre.

    Returns
    -------
    ScaledPoses
        In the world of the tracker, or else of the orientation sensor with its origin at the first frame's
        image origin, or else of the first frame.
    """
    unknowns, uncertainty, problem = problem.solve()
    path, sensors, evidence = problem.path, problem.sensors, problem.evidence
    centre = RigidTransform.from_translation(centre_mm)
    on_path = problem.columns[0]
    coefficients = unknowns[on_path]
    poses = path.chain.poses(coefficients)
    slopes = path.chain.frame_errors(coefficients, poses)
    covariance = np.einsum("nic,cd,njd->nij", slopes, uncertainty[on_path, on_path], slopes, optimize=True)
    from_first = centre * RigidTransform.from_matrix(poses) * centre.inv()
    world = RigidTransform.identity()
    if sensors:
        world = sensors[0].world_of(unknowns[problem.columns[1]])
        world = world * centre.inv() if sensors[0].places else RigidTransform.from_rotation(world.rotation)
    return ScaledPoses(
        poses=world * from_first,
        covariance=covariance,
        log_scale=float(np.log1p(path.mean_rates()[0] @ coefficients)),
        length_sigma=length_sigma(from_first, covariance, centre_mm),
        rests_on=(
            "images",
            *(sensor.name for sensor in sensors),
            *["crossing"] * (evidence is not None),
        ),
        evidence=evidence,
        details={f"{s.name} jitter": float(s.jitter[int(s.places)]) for s in sensors},
    )
