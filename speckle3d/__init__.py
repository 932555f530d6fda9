"""Freehand 2-D ultrasound sweeps to measured 3-D, with no position sensor or a small orientation sensor.

The public names below are loaded when first used (PEP 562), so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from speckle3d.config import Config, load_config
    from speckle3d.core.calibration import Calibration, calibrated
    from speckle3d.core.curves import DecorrelationCurves
    from speckle3d.core.errors import Speckle3DError
    from speckle3d.core.reconstruction import Reconstruction
    from speckle3d.core.sweep import Sweep
    from speckle3d.imaging.volume import compound
    from speckle3d.io.calibrations import read_calibration as load_calibration
    from speckle3d.io.calibrations import write_calibration
    from speckle3d.io.curves import read_curves as load_curves
    from speckle3d.io.curves import write_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.io.sweep_writer import write_sweep
    from speckle3d.io.volumes import read_volume, write_volume
    from speckle3d.pipeline import Tracked, calibrate_curves, correct, track
    from speckle3d.scoring.lengths import ModeError, compare_modes
    from speckle3d.simulation.presets import SimulationSettings, simulate
    from speckle3d.study.images import grey_images
    from speckle3d.study.job import JobResult, run_job

    __version__: str

_HOME = {
    "Calibration": "core.calibration",
    "Config": "config",
    "DecorrelationCurves": "core.curves",
    "JobResult": "study.job",
    "ModeError": "scoring.lengths",
    "Reconstruction": "core.reconstruction",
    "SimulationSettings": "simulation.presets",
    "Speckle3DError": "core.errors",
    "Sweep": "core.sweep",
    "Tracked": "pipeline",
    "calibrate_curves": "pipeline",
    "calibrated": "core.calibration",
    "compare_modes": "scoring.lengths",
    "compound": "imaging.volume",
    "correct": "pipeline",
    "grey_images": "study.images",
    "load_calibration": "io.calibrations:read_calibration",
    "load_config": "config",
    "load_curves": "io.curves:read_curves",
    "load_sweep": "io.load",
    "read_reconstruction": "io.reconstructions",
    "read_volume": "io.volumes",
    "run_job": "study.job",
    "simulate": "simulation.presets",
    "track": "pipeline",
    "write_calibration": "io.calibrations",
    "write_curves": "io.curves",
    "write_sweep": "io.sweep_writer",
    "write_volume": "io.volumes",
}
"""Where each public name lives, and what it is called there if that differs."""

__all__ = [
    "Calibration",
    "Config",
    "DecorrelationCurves",
    "JobResult",
    "ModeError",
    "Reconstruction",
    "SimulationSettings",
    "Speckle3DError",
    "Sweep",
    "Tracked",
    "calibrate_curves",
    "calibrated",
    "compare_modes",
    "compound",
    "correct",
    "grey_images",
    "load_calibration",
    "load_config",
    "load_curves",
    "load_sweep",
    "read_reconstruction",
    "read_volume",
    "run_job",
    "simulate",
    "track",
    "write_calibration",
    "write_curves",
    "write_sweep",
    "write_volume",
]


if not TYPE_CHECKING:  # or every misspelt name would pass as an object

    def __getattr__(name: str) -> object:
        """Load a public name, or the version, on first use."""
        if name == "__version__":
            return import_module("importlib.metadata").version(__name__)
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, there = _HOME[name].partition(":")
        value = getattr(import_module(f"{__name__}.{module}"), there or name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
