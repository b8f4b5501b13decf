"""Python imports of the motion library in threads of the server."""

from __future__ import annotations

import ast
import gc
import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from marey_server.motions import annotating, importing
from marey_server.motions.loading import LOADING

SLOW = ("marey_motion", "marey_server.motions.reading")
"""Modules that take long to import; the second one imports the motion library."""


def imports_in(function: ast.FunctionDef) -> set[int]:
    """Return the lines at which a function imports the motion library."""
    imports = (node for node in ast.walk(function) if isinstance(node, ast.ImportFrom))
    return {node.lineno for node in imports if (node.module or "").startswith(SLOW)}


@pytest.mark.parametrize("module", [annotating, importing], ids=lambda module: module.__name__.rpartition(".")[2])
def test_threads_of_the_server_import_the_motion_library_one_at_a_time(module: ModuleType) -> None:
    """Without the lock, one of two concurrent requests failed, but so rarely that it could be overlooked."""
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    found = set().union(*map(imports_in, functions))
    alone = {
        node.lineno
        for block in ast.walk(tree)
        if isinstance(block, ast.With) and ast.unparse(block.items[0].context_expr) == "LOADING"
        for node in block.body
    }
    assert found
    assert found <= alone


def test_the_garbage_collector_skips_modules_once_they_are_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "module_of_a_test.py").write_text("objects = [[] for _ in range(1000)]\n")
    monkeypatch.syspath_prepend(tmp_path)
    try:
        with LOADING:
            importlib.import_module("module_of_a_test")
        skipped = gc.get_freeze_count()
        assert skipped > 1000
        with LOADING:
            importlib.import_module("module_of_a_test")
        assert gc.get_freeze_count() <= skipped
    finally:
        gc.unfreeze()
        sys.modules.pop("module_of_a_test", None)
