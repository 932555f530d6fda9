"""Settings of compounding, as the configuration, the command line and Python have them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

Splat = Literal["nearest", "linear"]
Rule = Literal["mean", "maximum", "latest", "weighted", "plus"]
Levels = Literal["log", "linear", "stored"]
VoxelType = Literal["float32", "uint8", "int16", "uint16"]


class CompoundingSettings(BaseModel):
    """Settings of compounding."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_mm: float = Field(0.2, gt=0, description="Side of a voxel.")
    splat: Splat = Field(
        "nearest",
        description="Into the voxel a sample lies in, or shared out to the eight around it (linear).",
    )
    rule: Rule = Field(
        "mean",
        description="What several samples of a voxel make: their mean, the largest, the one of the latest "
        "frame, or the mean weighted by how well each frame's place is known; plus: the mean kept in whole "
        "grey levels as PLUS and 3D Slicer keep it, to compare with their volumes.",
    )
    backward_mm: float = Field(
        0.0,
        ge=0,
        description="If above zero, look each voxel up between the images nearest on either side, at most "
        "this far away, in place of sharing out samples: for sparse sweeps.",
    )
    fill_radius: int = Field(
        3,
        ge=0,
        description="Half the edge, in voxels, of the largest cube from which a hole is filled; 0: none.",
    )
    fill_mm: float = Field(
        0.0,
        ge=0,
        description="If above zero, in place of the radius in voxels: holes are filled from boxes that reach "
        "this far along each axis, whatever the voxels' shape.",
    )
    voxel_type: VoxelType = Field("uint8", description="Type of the voxels; in float32 empty ones are NaN.")
    levels: Literal["auto", "log", "linear", "stored"] = Field(
        "auto",
        description="log (compressed to 0-255), linear (echo amplitude), or stored; auto: stored for B-mode, "
        "log for RF and I/Q.",
    )
    dynamic_range_db: float = Field(60.0, gt=0, description="Range of the log-compressed grey levels.")
    max_memory_gb: float = Field(8.0, gt=0, description="Memory that making a volume may take.")

    @model_validator(mode="before")
    @classmethod
    def _amplitudes_are_float32(cls, values: Any) -> Any:
        """Echo amplitudes are no grey levels of one byte: unless a type is given, they are float32."""
        if isinstance(values, dict) and values.get("levels") == "linear":
            return {"voxel_type": "float32", **values}
        return values

    @field_validator("levels")
    @classmethod
    def _levels_fit(cls, levels: str, info: ValidationInfo) -> str:
        """Refuse amplitudes in whole numbers: those of B-mode are below one, and few of RF fit in a byte."""
        kind = info.data.get("voxel_type", "float32")
        if levels == "linear" and kind != "float32":
            raise PydanticCustomError(
                "levels", "expected voxel type float32 with it, got {kind}", {"kind": kind}
            )
        return levels
