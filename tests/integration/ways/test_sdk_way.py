"""The notebook and the page about the SDK, run cell by cell and example by example."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from docs.generate import ROOT
from tests.support.evaluation_takes import write_walks
from tests.support.server_process import ServerProcess

from marey_client.project import ProjectHandle

NOTEBOOK = ROOT / "docs" / "tutorial" / "folder-to-model.ipynb"
PAGE = ROOT / "docs" / "how-to" / "use-python.md"


@pytest.fixture
def names(
    new_lab: Callable[[], ProjectHandle],
    server: ServerProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> dict[str, Any]:
    """The names of a new script, which runs beside a folder `takes` and uses an empty project `lab`."""
    write_walks(tmp_path / "takes", seconds=3.0)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAREY_SERVER", server.url)
    monkeypatch.setenv("MAREY_TOKEN", server.token)
    return {"lab": new_lab()}


def test_the_notebook_goes_from_a_folder_to_a_model(names: dict[str, Any]) -> None:
    lab: ProjectHandle = names.pop("lab")
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert sum(bool(line) for cell in code for line in cell.splitlines()) <= 30
    for cell in code:
        exec(compile(cell, str(NOTEBOOK), "exec"), names)
    assert [one.path for one in lab.models] == ["step"]
    assert names["hips"].shape == (60, 1, 3)
    assert names["batch"][0].shape == (60, 3, 3)
    assert not {one.clip.id for one in names["parts"]["train"].windows} & {
        one.clip.id for one in names["parts"]["test"].windows
    }


def test_the_page(names: dict[str, Any]) -> None:
    lab: ProjectHandle = names.pop("lab")
    takes = Path("takes")
    for number, file in enumerate(sorted(takes.iterdir())):
        file.rename(takes / "walk.bvh") if number == 0 else file.rename(takes / f"walk-{number}.bvh")
    for example in re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL):
        exec(compile(example, str(PAGE), "exec"), names)
    assert names["ended"].result["refused"] == []
    assert (names["positions"].shape, names["contacts"].shape) == ((100, 2, 3), (names["walk"].frames, 2))
    assert (names["counted"], names["state"]) == (len(lab.clips), "succeeded")
    assert "<svg" in Path("walk.svg").read_text("utf-8")
    assert [one.path for one in lab.clips.where("moved")] == ["moved/walk-moved"]
