"""Simulated sweeps with truth: diffraction beam, scatterers, hand motion, sensors on their own clocks."""

from speckle3d.simulation.presets import SimulatedSweep, SimulationSettings, simulate

__all__ = ["SimulatedSweep", "SimulationSettings", "simulate"]
