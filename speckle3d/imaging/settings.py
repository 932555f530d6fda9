"""Settings of compounding, as the configuration, the command line and Python have them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Splat = Literal["nearest", "linear"]
Rule = Literal["mean", "maximum", "latest", "weighted"]
Levels = Literal["log", "linear", "stored"]
VoxelType = Literal["float32", "uint8", "int16", "uint16"]


class CompoundingSettings(BaseModel):
    """How images become voxels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_mm: float = Field(0.2, gt=0, description="Side of a voxel.")
    splat: Splat = Field(
        "nearest",
        description="Into the voxel a sample lies in, or shared out to the eight around it (linear).",
    )
    rule: Rule = Field(
        "mean",
        description="What several samples of a voxel make: their mean, the largest, the one of the latest "
        "frame, or the mean weighted by how well each frame's place is known.",
    )
    fill_radius: int = Field(
        3,
        ge=0,
        description="Half the edge, in voxels, of the largest cube from which a hole is filled; 0: none.",
    )
    reach_mm: float | None = Field(
        None,
        gt=0,
        description="For sparse sweeps: instead of splatting and filling, each voxel is interpolated between "
        "the images nearest on either side, no farther from it than this.",
    )
    voxel_type: VoxelType = Field("uint8", description="Type of the voxels; in float32 empty ones are NaN.")
    levels: Levels | None = Field(
        None,
        description="Log-compressed to 0-255, linear echo amplitude, or as stored; by default as stored for "
        "B-mode and log-compressed for RF and I/Q.",
    )
    dynamic_range_db: float = Field(60.0, gt=0, description="Range of the log-compressed grey levels.")
    max_memory_gb: float = Field(
        2.5,
        gt=0,
        description="Memory to work in; a larger volume is made in slabs, written as they are done.",
    )
    max_file_gb: float = Field(
        64.0, gt=0, description="Largest volume to make: larger ones are more often due to a wrong unit."
    )
