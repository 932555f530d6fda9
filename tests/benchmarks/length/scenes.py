"""RF sweeps whose length is to be found, and curves that do not belong to their probe."""

from cache import DEFAULT, key_of

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import Sweep
from speckle3d.io.curves import read_curves, write_curves
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.phantom_curves import calibrate_curves
from speckle3d.simulation.beam import Probe, tabulate_beam
from speckle3d.simulation.medium import fully_developed
from speckle3d.simulation.movement import stepped_poses
from speckle3d.simulation.presets import simulate
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.settings import SimulationSettings

FIRST_SEED = 970_001
"""Judged seeds count from here; development used 1 to 99."""
LENGTH_MM = 24.0
_CROSSED = {"preset": "crossed", "vectors": 96, "samples": 2600, "length_mm": LENGTH_MM, "frames": 150}
_STEPS = {"steps": 41, "step_mm": 0.05, "blocks": 3}


def crossing_pair(seed, angle_deg, folder=DEFAULT):
    """Two tissue sweeps of 24 mm that cross in their middle; the first is the same at all angles."""
    settings = [SimulationSettings(seed=seed, crossing_deg=a, **_CROSSED) for a in (90.0, angle_deg)]
    stem = f"length-{seed}-{key_of(settings[0].model_dump_json())}"
    paths = folder / f"{stem}.h5", folder / f"{stem}-crossing-{angle_deg:g}.h5"
    for number, path in enumerate(paths):
        _made(path, settings[number], number)
    return paths


def short(seed, folder=DEFAULT):
    """A sweep of 3.6 to 6 mm with both sensors, over tissue or a phantom."""
    settings = SimulationSettings(
        preset=("tissue", "phantom")[seed % 2],
        seed=seed,
        vectors=48,
        samples=2600,
        length_mm=3.6 + 0.4 * (seed % 7),
        frames=45,
    )
    return _made(folder / f"short-{seed}-{key_of(settings.model_dump_json())}.h5", settings)


def _made(path, settings, number=0):
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".part{number}.h5")
        write_sweep(part, simulate(settings)[number].sweep)
        part.replace(path)
    return path


def stepped_phantom(probe, attenuation_db_cm_mhz, seed, folder=DEFAULT):
    """Exact steps over fully developed speckle, as decorrelation curves are measured on."""
    path = folder / f"steps-{seed}-{key_of(f'{probe}{attenuation_db_cm_mhz}{_STEPS}')}.h5"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        medium = fully_developed(seed)
        beam = tabulate_beam(probe, attenuation_db_cm_mhz=attenuation_db_cm_mhz)
        gap_mm = 2.0 * float(beam.elevation_extent_mm.max())
        poses = stepped_poses(_STEPS["steps"], _STEPS["step_mm"], _STEPS["blocks"], gap_mm)
        grid = ImageGrid(48, 3818, probe.pitch_mm, probe.signal.sample_spacing_mm)
        frames = SimulatedFrames(beam, medium, poses, grid, 40.0, seed)
        times = [number / 25.0 for number in range(len(poses))]
        write_sweep(path, Sweep(frames, grid, probe.signal, times, truth=poses, name=f"steps-{seed}"))
    return load_sweep(path)


def borrowed_curves(focus_mm, attenuation_db_cm_mhz, folder=DEFAULT):
    """Curves of a phantom and a lens that are not the sweeps': theirs are 20 mm and 0.5 dB/cm/MHz."""
    probe = Probe(elevation_focus_mm=focus_mm)
    path = folder / f"curves-{key_of(f'{probe}{attenuation_db_cm_mhz}{_STEPS}')}.h5"
    if not path.is_file():
        sweeps = [stepped_phantom(probe, attenuation_db_cm_mhz, seed, folder) for seed in (11, 12)]
        write_curves(path, calibrate_curves(sweeps))
    return read_curves(path)
