"""Simulated sweeps with truth: diffraction beam, scatterers, hand motion, sensors on their own clocks.

`SimulationSettings` validates what users choose; models of probe, hand, medium and sensors are plain
dataclasses, since only presets make them.
"""
