"""Settings of a simulation, as given on the command line and kept in files; nothing heavy is imported."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Reflector = Literal["wall", "bar"]
Preset = Literal["phantom", "tissue", "reversal", "rotation", "crossed", "stepped", "plane", "wires"]


class SimulationSettings(BaseModel):
    """Settings of a simulated sweep; the same settings give the same samples."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Preset = Field(
        "phantom",
        description="phantom: speckle with inclusions, one way. tissue: layers, one way. reversal: tissue, "
        "forward and back. rotation: phantom with a deliberate turn. crossed: tissue, two sweeps. stepped: "
        "exact steps in uniform speckle, for curves. plane, wires: a bath's floor, or crossing wires in it, "
        "for calibration; their sensors are not calibrated.",
    )
    seed: int = Field(0, ge=0, description="Same seed and settings, same sweep.")
    vectors: int = Field(127, ge=1, le=1024, description="Vectors in a frame.")
    samples: int = Field(3818, ge=256, le=3818, description="Samples in a vector.")
    array: Literal["linear", "curved", "phased"] = Field(
        "linear", description="Whether vectors are parallel, or spread from a curved or a phased array."
    )
    radius_mm: float = Field(60.0, gt=0, le=200, description="curved: radius of the array's face.")
    sector_deg: float = Field(
        60.0, gt=0, le=120, description="curved, phased: angle between the first vector and the last."
    )
    length_mm: float = Field(20.0, gt=0, le=200, description="Length of the sweep.")
    frames: int | None = Field(
        None,
        ge=2,
        description="Frames; by default eight per mm, twice that where it comes back, and 150 of plane and "
        "wires.",
    )
    frame_rate_hz: float = Field(25.0, gt=0, le=1000, description="Frames per second of a hand-held sweep.")
    steps: int = Field(41, ge=2, description="stepped: frames in a block.")
    step_mm: float = Field(0.05, gt=0, description="stepped: distance between them.")
    blocks: int = Field(4, ge=1, description="stepped: independent blocks.")
    turn_deg: float = Field(5.0, ge=-30, le=30, description="rotation: turn from first to last frame.")
    turn_axis: Literal["tilt", "yaw"] = Field("tilt", description="rotation: the axis of the turn.")
    crossing_deg: float = Field(90.0, gt=0, lt=180, description="crossed: angle between the sweeps.")
    fan_deg: float = Field(
        0.0,
        ge=0,
        le=90,
        description="crossed: tilt within each sweep, half either way; calibration needs it.",
    )
    uncalibrated: bool = Field(
        False, description="Do not say how the sensors sit on the probe: a calibration will."
    )
    snr_db: float = Field(
        40.0, ge=-10, le=80, description="Speckle over electronic noise at the transmit focus."
    )
    reflector: Reflector = Field(
        "wall", description="plane: the floor (wall), or the bar of the Cambridge phantom."
    )
    duration_s: float = Field(30.0, gt=0, le=600, description="plane, wires: how long the scan lasts.")
    tilt_range_deg: float = Field(25.0, ge=0, le=60, description="plane, wires: tilt, either way.")
    sensor_noise: float = Field(
        1.0, ge=0, le=10, description="plane, wires: factor on the noise of both sensors; 0: exact ones."
    )
    signal: Literal["rf", "iq", "bmode"] = Field(
        "rf", description="Echoes as they come, their I/Q, or 8-bit grey levels."
    )
    decimation: int | None = Field(
        None,
        ge=1,
        description="iq, bmode: samples of the echoes in one that is stored; by default as many as leave I/Q "
        "half more than their band, and rows of 0.05 mm.",
    )
    dynamic_range_db: float = Field(
        60.0, gt=0, le=200, description="bmode: from black to white, which is 20 dB over the mean of speckle."
    )

    @field_validator("radius_mm", "sector_deg")
    @classmethod
    def _of_spreading_vectors(cls, value: float, info: ValidationInfo) -> float:
        parallel = info.data.get("array", "linear") == "linear"
        if parallel and value != cls.model_fields[str(info.field_name)].default:
            raise ValueError("expected with array curved or phased, whose vectors spread")
        return value
