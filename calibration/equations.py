"""A calibration's equations as bare arrays, and chains as bare matrices: what the solver iterates on.

`Chain` and `ImagePoints` hold transforms, which check themselves whenever they are made. A solution takes
hundreds of steps, each a fraction of a millisecond: they are taken apart once, put together at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.chain import CHAIN, Chain, ImagePoints, Phantom, PixelPrior, canonical
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.kernels.chain import chain_derivatives, chain_residuals, placed_between, turned
from speckle3d.kernels.chain_fit import fit_chain

_MOST_STEPS = 200


class BareChain(NamedTuple):
    """A `Chain` as arrays.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
    probe, target : ndarray, shape (4, 4)
        ``sensor_from_image`` and ``target_from_world``.
    """

    pixel_mm: FloatArray
    probe: FloatArray
    target: FloatArray

    @classmethod
    def of(cls, chain: Chain) -> BareChain:
        """Take a chain apart."""
        pixel_mm = np.array(chain.pixel_mm, dtype=float)
        return cls(pixel_mm, chain.sensor_from_image.as_matrix(), chain.target_from_world.as_matrix())

    @property
    def chain(self) -> Chain:
        """Put the chain together."""
        probe, target = (RigidTransform(matrix, normalize=False) for matrix in (self.probe, self.target))
        return Chain(self.pixel_mm, probe, target)

    @property
    def on_image(self) -> FloatArray:
        """Parameters in frames that lie on the image and on the phantom: zero but for pixel sizes."""
        return np.concatenate([self.pixel_mm, np.zeros(len(CHAIN) - 2)])

    def moved_to(self, parameters: FloatArray) -> BareChain:
        """Replace the parameters of `on_image` by others."""
        angles, pixel_mm = canonical(parameters[5:8], parameters[:2])
        image = _matrix(parameters[2:5], angles)
        world = _matrix(parameters[8:11], parameters[11:14])
        return BareChain(pixel_mm, self.probe @ image, world @ self.target)


@dataclass(frozen=True)
class Equations:
    """What must vanish for every point of a phantom, as contiguous arrays for the kernels.

    Attributes
    ----------
    pixels : ndarray, shape (n, 2)
    turns, shifts_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        ``world_from_sensor``.
    rows, offsets : ndarray, shapes (n, r, 3) and (n, r)
        See `Phantom.vanishing`.
    """

    pixels: FloatArray
    turns: FloatArray
    shifts_mm: FloatArray
    rows: FloatArray
    offsets: FloatArray

    @classmethod
    def of(cls, points: ImagePoints, phantom: Phantom) -> Equations:
        """Those of the points of a phantom."""
        arrays = (points.pixels, points.turns, points.shifts_mm, *phantom.vanishing(points))
        return cls(*(np.ascontiguousarray(array, dtype=float) for array in arrays))

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, chosen: BoolArray) -> Equations:
        return Equations(
            self.pixels[chosen],
            self.turns[chosen],
            self.shifts_mm[chosen],
            self.rows[chosen],
            self.offsets[chosen],
        )

    def residuals(self, chain: BareChain) -> FloatArray:
        """What does not vanish, shape (n, r)."""
        values = np.empty(self.offsets.shape)
        chain_residuals(
            chain.pixel_mm,
            chain.probe,
            chain.target,
            self.pixels,
            self.turns,
            self.shifts_mm,
            self.rows,
            self.offsets,
            values,
        )
        return values

    def near(self, chain: BareChain) -> Equations:
        """The same in frames that lie where a chain says the image and the phantom are."""
        turns, shifts_mm = np.empty_like(self.turns), np.empty_like(self.shifts_mm)
        placed_between(chain.probe, chain.target, self.turns, self.shifts_mm, turns, shifts_mm)
        return Equations(self.pixels, turns, shifts_mm, self.rows, self.offsets)

    def derivatives(
        self, parameters: FloatArray, columns: IntArray, weights: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals, shape (n r,), and their derivatives by some parameters, shape (n r, p), both weighted.

        Parameters
        ----------
        parameters : ndarray, shape (14,)
            In the order of `CHAIN`.
        columns : ndarray of int, shape (p,)
            Of the derivatives, in `CHAIN`.
        weights : ndarray, shape (n, r), optional
        """
        values = np.empty(self.offsets.size)
        jacobian = np.empty((values.size, len(columns)))
        chain_derivatives(
            np.ascontiguousarray(parameters, dtype=float),
            self.pixels,
            self.turns,
            self.shifts_mm,
            self.rows,
            self.offsets,
            columns,
            np.ones(self.offsets.shape) if weights is None else weights,
            values,
            jacobian,
        )
        return values, jacobian

    @staticmethod
    def known(prior: PixelPrior | None, sigma: float, in_rows: bool) -> FloatArray:
        """A prior as `fit_chain` takes it, against residuals of standard deviation `sigma`, shape (4,)."""
        if prior is None:
            return np.array([1.0, 1.0, 0.0, 0.0])
        return np.array([*prior.pixel_mm, sigma / prior.error, float(in_rows)])

    def least_squares(
        self,
        chain: BareChain,
        columns: IntArray,
        weights: FloatArray | None,
        known: FloatArray,
        tolerance: float,
    ) -> tuple[FloatArray, int, bool]:
        """Parameters of least squares in frames where a chain says that the image and the phantom lie.

        Returns
        -------
        parameters : ndarray, shape (14,)
        steps : int
        converged : bool

        Raises
        ------
        InvalidInputError
            If there are fewer residuals than parameters, or some are not finite.
        """
        count = self.offsets.size + (2 if known[2] else 0)
        if count < len(columns):
            raise InvalidInputError(f"expected at least {len(columns)} residuals, got {count}")
        found = chain.on_image
        steps, converged = fit_chain(
            np.stack([chain.probe, chain.target]),
            self.pixels,
            self.turns,
            self.shifts_mm,
            self.rows,
            self.offsets,
            np.ones(self.offsets.shape) if weights is None else weights,
            columns,
            known,
            tolerance,
            _MOST_STEPS,
            found,
        )
        if steps < 0:
            raise InvalidInputError("expected finite residuals at the starting point, got some that are not")
        return found, steps, converged


def columns_of(names: tuple[str, ...]) -> IntArray:
    """Where parameters are in `CHAIN`."""
    return np.array([CHAIN.index(name) for name in names], dtype=np.int64)


def _matrix(shift: FloatArray, angles: FloatArray) -> FloatArray:
    """Rigid transform by a shift and fixed angles, shape (4, 4)."""
    rotation = np.empty((3, 3))
    turned(np.ascontiguousarray(angles, dtype=float), rotation, np.empty((3, 3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix
