"""Layouts of exported folders; commands list them without loading the documents."""

from __future__ import annotations

from typing import Literal

Layout = Literal["files", "huggingface", "lerobot"]
"""A tree of motion files, a dataset repository of the Hugging Face Hub, or a LeRobotDataset."""
LAYOUTS: tuple[Layout, ...] = ("files", "huggingface", "lerobot")
