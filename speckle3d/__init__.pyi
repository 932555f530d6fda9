# The public names: read by type checkers, and by lazy_loader when the package is imported.
from .config import Config as Config
from .config import load_config as load_config
from .core.calibration import Calibration as Calibration
from .core.calibration import calibrated as calibrated
from .core.curves import DecorrelationCurves as DecorrelationCurves
from .core.errors import Speckle3DError as Speckle3DError
from .core.reconstruction import Reconstruction as Reconstruction
from .core.sweep import Sweep as Sweep
from .corrections import correct as correct
from .crossing_sweeps import cross_sweeps as cross_sweeps
from .imaging.volume import compound as compound
from .io.calibrations import load_calibration as load_calibration
from .io.calibrations import write_calibration as write_calibration
from .io.curves import load_curves as load_curves
from .io.curves import write_curves as write_curves
from .io.import_settings import ImportSettings as ImportSettings
from .io.load import load_sweep as load_sweep
from .io.readers import Reader as Reader
from .io.reconstructions import read_reconstruction as read_reconstruction
from .io.sweep_writer import write_sweep as write_sweep
from .io.volumes import read_volume as read_volume
from .io.volumes import write_volume as write_volume
from .phantom_curves import calibrate_curves as calibrate_curves
from .pipeline import Tracked as Tracked
from .pipeline import track as track
from .scoring.lengths import ModeError as ModeError
from .scoring.lengths import compare_modes as compare_modes
from .simulation.presets import SimulationSettings as SimulationSettings
from .simulation.presets import simulate as simulate
from .study.images import grey_images as grey_images
from .study.job import JobResult as JobResult
from .study.job import run_job as run_job

__version__: str
