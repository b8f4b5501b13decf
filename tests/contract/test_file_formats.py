"""Table of file formats: every format has the reader, the writer and the file name endings that the table states."""

from __future__ import annotations

import inspect
import re
from importlib import import_module

import numpy as np
import pytest
from docs.generate import ROOT

from marey_motion.clip import Clip
from marey_motion.exporting import write_clip_file
from marey_motion.formats import detect_format, read_motion, write_predecessor_skeleton
from marey_motion.gait import generate_gait
from marey_schemas.formats import EXPORT_FORMATS, FORMATS, IMPORTED, MOTION_FORMATS, FileFormat, format_named
from marey_schemas.options.imports import ImportOptions

by_name = pytest.mark.parametrize("row", FORMATS, ids=lambda row: str(row.name))


@pytest.fixture(scope="module")
def clip() -> Clip:
    return generate_gait(1.2, 0.0, 1.0, 30.0)


@by_name
def test_a_format_that_is_read_has_a_reader_called_after_it(row: FileFormat) -> None:
    if row.reads:
        assert callable(getattr(import_module(f"marey_motion.formats.{row.name}"), f"read_{row.name}"))


def test_the_architecture_shows_how_readers_of_motion_are_called() -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
    shown = re.search(r"`read_<name>\((.*?)\)`", page)
    assert shown is not None
    for row in (row for row in FORMATS if "motion" in row.reads):
        reader = getattr(import_module(f"marey_motion.formats.{row.name}"), f"read_{row.name}")
        taken = inspect.signature(reader).parameters.values()
        positional = [one.name for one in taken if one.kind is one.POSITIONAL_OR_KEYWORD]
        always = [f"{one.name}={one.default}" for one in taken if one.name == "frame_rate_hz"]
        assert shown[1] == ", ".join((*positional, "*", *always)), row.name


@pytest.mark.parametrize("name", MOTION_FORMATS)
def test_a_clip_written_in_a_format_has_its_ending_and_is_recognised_as_that_format(name: str, clip: Clip) -> None:
    row = format_named(name)
    unit = row.units[0]
    written = write_clip_file(clip, name, unit=unit)
    assert (written.suffix, written.media_type) == (row.endings[0], row.media_type)
    assert row.archives == row.endings or detect_format(written.data, "take").name == name
    companion = write_predecessor_skeleton(clip.skeleton) if row.companion == "predecessor" else None
    read = read_motion(
        written.data, f"take{written.suffix}", companion=companion, options=ImportOptions(frame_rate_hz=30.0)
    )
    assert read.source.format == name
    assert read.clip is not None
    np.testing.assert_allclose(read.clip.root_translations, clip.root_translations, atol=1e-5)


@by_name
def test_a_format_without_a_reader_says_why(row: FileFormat) -> None:
    assert bool(row.reads) != bool(row.unread) or row not in IMPORTED


def test_no_two_imported_formats_share_an_ending() -> None:
    endings = [ending for row in IMPORTED for ending in row.endings + row.other_endings]
    assert len(endings) == len(set(endings))


def test_exports_and_imports_accept_what_the_table_has_and_nothing_else() -> None:
    from marey_schemas.queue.job_params import ExportParams

    assert ExportParams.model_json_schema()["properties"]["format"]["enum"] == list(EXPORT_FORMATS)
    with pytest.raises(ValueError, match="Input should be"):
        ExportParams(format="fbx")
    with pytest.raises(ValueError, match="Input should be"):
        ImportOptions(unit="parsec")
