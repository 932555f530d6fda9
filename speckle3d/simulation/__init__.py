"""Simulated sweeps with truth: diffraction beam, scatterers, hand motion, sensors on their own clocks."""

from speckle3d.simulation.presets import simulate
from speckle3d.simulation.settings import SimulatedSweep, SimulationSettings

__all__ = ["SimulatedSweep", "SimulationSettings", "simulate"]
