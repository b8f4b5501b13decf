"""Examples in the docstrings of the library run without error, and every exported name has one."""

import doctest
import importlib
from pathlib import Path

import pytest

import marey_motion

EXPORTED: list[str] = vars(marey_motion)["__all__"]

PACKAGE = Path(marey_motion.__file__).parent


def modules_with_examples() -> list[str]:
    own = {
        ".".join(("marey_motion", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")
        for file in PACKAGE.rglob("*.py")
        if ">>> " in file.read_text(encoding="utf-8")
    }
    return sorted(own | {getattr(marey_motion, name).__module__ for name in EXPORTED})


@pytest.mark.parametrize("name", EXPORTED)
def test_an_exported_name_has_an_example(name: str) -> None:
    assert ">>> " in (getattr(marey_motion, name).__doc__ or "")


@pytest.mark.parametrize("module", modules_with_examples())
def test_the_examples_of_a_module_give_what_they_print(module: str) -> None:
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.REPORT_NDIFF)
    for example in doctest.DocTestFinder().find(importlib.import_module(module)):
        runner.run(example, out=report.append)
    assert runner.failures == 0, "".join(report)
