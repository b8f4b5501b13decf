"""Fixtures of the tests of pages: a project that contains what a page assumes, and the reader of the page."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.printed_pages import PrintedPage
from tests.support.short_walks import write_named_walks

from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_schemas.items import ItemChange
from marey_schemas.options.imports import ImportOptions


@pytest.fixture
def reads(run: CommandLine) -> Callable[..., PrintedPage]:
    """Function that opens a page, such as `docs/how-to/retarget.md`, for a reader who types its commands."""

    def open_page(page: str, **options: Any) -> PrintedPage:
        return PrintedPage(page, run, **options)

    return open_page


@pytest.fixture
def empty_lab(new_lab: Callable[[], ProjectHandle]) -> ProjectHandle:
    return new_lab()


@pytest.fixture
def add_walks(empty_lab: ProjectHandle, tmp_path: Path) -> Callable[..., None]:
    """Function that adds walks to a folder of the project `lab`; options are those of `write_named_walks`."""

    def add(collection: str, *names: str, **options: Any) -> None:
        folder = write_named_walks(tmp_path / "recorded" / collection, *names, **options)
        empty_lab.imports.upload(find_files([folder]).files, ImportOptions(collection=collection))

    return add


@pytest.fixture
def name_skeletons(empty_lab: ProjectHandle) -> Callable[..., None]:
    """Function that gives the skeletons of the project `lab` names of a page, the oldest skeleton first."""

    def rename(*names: str) -> None:
        skeletons = list(empty_lab.skeletons.list(sort="id"))
        for skeleton, name in zip(skeletons, names, strict=True):
            skeleton.change(ItemChange(name=name, collection="skeletons"))

    return rename
