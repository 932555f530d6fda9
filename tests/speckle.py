"""Fully developed speckle with a known spectrum, seen by an image plane that moves within it.

Written for the tests alone and independent of the package's simulator: complex Gaussian noise, shaped in
the Fourier domain on a fine periodic grid, read at any point by quintic splines.
"""

from dataclasses import replace

import numpy as np
from scipy import fft, ndimage

from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import RFSettings

LATERAL_MM, AXIAL_MM = 0.35, 0.12
GRID = ImageGrid(
    vectors=96, samples=420, vector_pitch_mm=0.3, sample_spacing_mm=0.06, first_sample_depth_mm=0.5
)


def gaussian(k, sigma_mm):
    """Spectrum of amplitude whose intensity correlates as exp(-d^2 / 2 sigma^2)."""
    return np.exp(-((k * sigma_mm) ** 2))


def triangle(k, sigma_mm):
    """Spectrum of an evenly weighted aperture, two-way: intensity correlates as sinc^4, alike near zero."""
    return np.maximum(0.0, 1.0 - np.abs(k) * sigma_mm / np.sqrt(3.0))


def triangle_correlation(d, sigma_mm):
    """Correlation of intensity that belongs to `triangle`."""
    return np.sinc(np.sqrt(3.0) / sigma_mm * np.asarray(d) / (2.0 * np.pi)) ** 4


class Speckle:
    """A plane of speckle, `margin_mm` wider than an image on every side."""

    def __init__(self, rng, spectrum=gaussian, grid=GRID, margin_mm=6.0):
        sigmas_mm = LATERAL_MM, AXIAL_MM
        self.grid = grid
        # 3.5 samples to a standard deviation: quintic splines are then right to about 1e-4.
        self.step = np.array(sigmas_mm) / 3.5
        sides = np.array([grid.width_mm, grid.depth_mm - grid.first_sample_depth_mm]) + 2 * margin_mm
        shape = [fft.next_fast_len(int(n)) for n in sides / self.step]
        noise = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        for axis in (0, 1):
            k = 2 * np.pi * fft.fftfreq(shape[axis], self.step[axis])
            side = np.sqrt(spectrum(k, sigmas_mm[axis]))
            noise = noise * (side[:, None] if axis == 0 else side)
        field = fft.ifft2(noise)
        field /= np.sqrt(np.mean(np.abs(field) ** 2))
        self.splines = [
            ndimage.spline_filter(part, order=5, mode="grid-wrap") for part in (field.real, field.imag)
        ]
        self.origin = np.array([-margin_mm, grid.first_sample_depth_mm - margin_mm])

    def image(self, x_mm=0.0, y_mm=0.0, roll_rad=0.0):
        """Complex amplitude, shape (vector, sample), of an image moved in its plane about its centre."""
        g = self.grid
        x = np.arange(g.vectors) * g.vector_pitch_mm - g.centre_mm[0]
        y = np.arange(g.samples) * g.sample_spacing_mm + g.first_sample_depth_mm - g.centre_mm[1]
        x, y = np.meshgrid(x, y, indexing="ij")
        c, s = np.cos(roll_rad), np.sin(roll_rad)
        points = np.stack([c * x - s * y + x_mm + g.centre_mm[0], s * x + c * y + y_mm + g.centre_mm[1]])
        at = (points - self.origin[:, None, None]) / self.step[:, None, None]
        real, imaginary = (
            ndimage.map_coordinates(part, at, order=5, mode="grid-wrap", prefilter=False)
            for part in self.splines
        )
        return real + 1j * imaginary


def intensity(amplitude):
    """Echo intensity as the kernels take it."""
    return (np.abs(amplitude) ** 2).astype(np.float32)


def mix(amplitude, independent, rho):
    """`amplitude` mixed with independent speckle so that intensities correlate by `rho`."""
    return np.sqrt(rho) * amplitude + np.sqrt(1.0 - rho) * independent


RF = RFSettings(
    sampling_rate_hz=40e6, speed_of_sound_m_s=1540.0, centre_frequency_hz=7e6, bandwidth_hz=(4e6, 10e6)
)
KEY = CurveKey(RF, GRID.vector_pitch_mm, 3.6, 3.0, 2.0)
ECHO = replace(KEY, correlation_of="echo")


def gaussian_correlation(d, sigma_mm):
    """Correlation of intensity that belongs to `gaussian`."""
    return np.exp(-(np.asarray(d) ** 2) / (2 * sigma_mm**2))


def curves(sigma_mm=0.45, cells=25.0, depth_mm=(5.0, 30.0), largest_mm=2.0, key=KEY):
    """Curves of a Gaussian beam, its width the same (or given) at each depth."""
    distance = np.linspace(0.0, largest_mm, 201)
    widths = np.broadcast_to(sigma_mm, (len(depth_mm),))[:, None]
    rho = np.maximum(gaussian_correlation(distance, widths), 1e-9)
    return DecorrelationCurves(
        key, np.array(depth_mm), distance, rho, np.full(len(depth_mm), float(cells)), 100
    )
