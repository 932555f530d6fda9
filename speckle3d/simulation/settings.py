"""Settings of a simulation, as given on the command line and kept in files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.shown import shown
from speckle3d.core.sweep import Sweep
from speckle3d.simulation.bath import Reflector

Signal = Literal["rf", "iq", "bmode"]
Preset = Literal["phantom", "tissue", "reversal", "rotation", "crossed", "stepped", "plane", "wires"]
Mounting = Literal["bench", "published"]


class SimulationSettings(BaseModel):
    """What to simulate. The same settings give the same sweep.

    Parameters
    ----------
    preset : str
        phantom: speckle with inclusions, one way. tissue: layers, one way. reversal: tissue, forward and
        back. rotation: phantom with a deliberate turn. crossed: tissue, two sweeps at a right angle; for
        calibration they must fan, and their sensors must not know their mounting (`fan_deg`, `uncalibrated`).
        stepped: uniform speckle in exact elevational steps, for decorrelation curves. plane: a water bath's
        floor from all sides, for calibration. wires: two crossing wires in a water bath, likewise. The
        sensors of both are not calibrated to the image.
    frames : int, optional
        Frames of a hand-held sweep; by default eight per mm, twice that when it comes back. Of `plane` and
        `wires`: 150.
    steps, step_mm, blocks : int, float, int
        Of `stepped`: frames per block, their distance, and how many independent blocks.
    turn_deg : float
        Of `rotation`: the deliberate turn from first to last frame, about the axis `turn_axis`.
    reverse : bool
        Of `rotation`: sweep forward, then back, turning on.
    crossing_deg, fan_deg : float
        Of `crossed`: the angle between the sweeps, and how far the probe tilts in each, half either way.
    mounting : {"bench", "published"}
        How the tracker sits on the probe. bench: the same in every preset, so that a calibration made from
        one simulated scan serves every simulated sweep. published: as in table 3 of Prager et al. (1997).
    uncalibrated : bool
        Leave it to a calibration to find how the sensors sit on the probe.
    drift_mm : float
        Of hand-held sweeps: slow lateral and axial wander, standard deviation.
    wobble_mm, wobble_hz : float
        Of hand-held sweeps: deliberate to and fro along the elevational axis, amplitude and frequency.
    tremor_mm : float
        Of hand-held sweeps: tremor in every axis, standard deviation.
    snr_db : float
        Speckle over electronic noise at the transmit focus.
    reflector : str
        Of `plane`. wall: the floor. bar: the Cambridge phantom's, in the middle of the beam alone.
    duration_s : float
        Of `plane` and `wires`: how long the scan takes, whatever `frame_rate_hz` says.
    tilt_range_deg, roll_range_deg, yaw_range_deg : float
        Of `plane` and `wires`: how far the probe turns either way.
    depth_range_mm : tuple of float
        Of `plane` and `wires`: nearest and farthest depth of the floor, or of the crossing, in the image.
    floor_slope_deg : float
        Of `plane`: angle of the floor with the horizontal, in a random direction.
    sensor_noise : float
        Of `plane` and `wires`: factor on the noise of both sensors; 0 for exact ones.
    signal : {"rf", "iq", "bmode"}
        What the scanner stores: echoes as they come, their I/Q, or 8-bit grey levels.
    demodulation_frequency_hz : float, optional
        Of `iq`: what the echoes are shifted down by; by default their centre frequency.
    decimation : int, optional
        Of `iq` and `bmode`: samples of the echoes in one that is stored; by default as many as leave I/Q a
        quarter more than they need, and rows of 0.05 mm.
    dynamic_range_db : float
        Of `bmode`: from black to white, which is 20 dB over the mean of speckle.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Preset = "phantom"
    seed: int = Field(0, ge=0)
    vectors: int = Field(127, ge=1, le=1024)
    samples: int = Field(3818, ge=256, le=3818)
    length_mm: float = Field(20.0, gt=0, le=200)
    frames: int | None = Field(None, ge=2)
    frame_rate_hz: float = Field(25.0, gt=0, le=1000)
    steps: int = Field(41, ge=2)
    step_mm: float = Field(0.05, gt=0)
    blocks: int = Field(4, ge=1)
    turn_deg: float = Field(5.0, ge=-30, le=30)
    turn_axis: Literal["tilt", "yaw"] = "tilt"
    reverse: bool = False
    crossing_deg: float = Field(90.0, gt=0, lt=180)
    fan_deg: float = Field(0.0, ge=0, le=90)
    mounting: Mounting = "bench"
    uncalibrated: bool = False
    drift_mm: float = Field(0.5, ge=0, le=20)
    wobble_mm: float = Field(0.0, ge=0, le=5)
    wobble_hz: float = Field(3.0, ge=0.5, le=8)
    tremor_mm: float = Field(0.012, ge=0, le=1)
    snr_db: float = Field(40.0, ge=-10, le=80)
    reflector: Reflector = "wall"
    duration_s: float = Field(30.0, gt=0, le=600)
    tilt_range_deg: float = Field(25.0, ge=0, le=60)
    roll_range_deg: float = Field(11.0, ge=0, le=45)
    yaw_range_deg: float = Field(90.0, ge=0, le=180)
    depth_range_mm: tuple[float, float] = (12.0, 34.0)
    floor_slope_deg: float = Field(0.0, ge=0, le=60)
    sensor_noise: float = Field(1.0, ge=0, le=10)
    signal: Signal = "rf"
    demodulation_frequency_hz: float | None = Field(None, gt=0)
    decimation: int | None = Field(None, ge=1)
    dynamic_range_db: float = Field(60.0, gt=0, le=200)

    @field_validator("depth_range_mm")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 2.0 <= value[0] <= value[1] <= 44.0:
            raise ValueError("expected 2 <= nearest <= farthest <= 44")
        return value


@shown
@dataclass(frozen=True)
class SimulatedSweep:
    """A sweep whose frames are computed as they are read, and the settings that determine it.

    Parameters
    ----------
    sweep : Sweep
    settings : SimulationSettings
    tracker_from_image, orientation_from_image : RigidTransform, Rotation, optional
        The true ``sensor_from_image`` of sensors that the sweep leaves uncalibrated.
    """

    sweep: Sweep
    settings: SimulationSettings
    tracker_from_image: RigidTransform | None = None
    orientation_from_image: Rotation | None = None

    def description(self) -> dict[str, Any]:
        """Plain values for a file: the settings and, where it is for a calibration to find, the mounting."""
        values = self.settings.model_dump(mode="json")
        if self.tracker_from_image is not None:
            values["tracker_sensor_from_image"] = self.tracker_from_image.as_matrix().tolist()
        if self.orientation_from_image is not None:
            wxyz = self.orientation_from_image.as_quat(scalar_first=True)
            values["orientation_sensor_from_image_wxyz"] = wxyz.tolist()
        return values
