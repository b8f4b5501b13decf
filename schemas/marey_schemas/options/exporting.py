"""Options of motion files that are written for other programs."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from marey_schemas.base import Options
from marey_schemas.formats import DEFAULT_FORMAT, DEFAULT_UNIT, MOTION_FORMATS, ExportFormat, WrittenUnit, format_named


class MotionFileOptions(Options):
    """Format of written motion files, with options that depend on the format."""

    format: ExportFormat = Field(DEFAULT_FORMAT, description="Format of the written files.")
    unit: WrittenUnit = Field(
        DEFAULT_UNIT, description="Unit of length of the files, for formats without a fixed unit."
    )
    fold_positions: bool = Field(
        False,
        description="In BVH files, write positions only for the root, for programs that ignore positions of other "
        "joints. The path of the joint that carries the body is transferred to the root, and other joints get "
        "their median offsets.",
    )

    @model_validator(mode="after")
    def _folds_channels(self) -> Self:
        if self.fold_positions and not (self.format in MOTION_FORMATS and format_named(self.format).euler):
            raise ValueError(f"fold_positions: files of the format {self.format} have no position channels; use bvh")
        return self
