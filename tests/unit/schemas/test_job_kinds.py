"""The declarations of job kinds."""

import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from typing import Any

import pytest

from marey_schemas.kinds import Kind
from marey_schemas.queue import job_kinds
from marey_schemas.queue.job_kinds import BUILT_IN, IMPORT, UnknownKindError, find_kind
from marey_schemas.queue.job_params import RetargetParams
from marey_schemas.queue.jobs import InputSpec
from marey_schemas.queue.kind_declaration import KindDeclaration


def declare(**fields: Any) -> KindDeclaration:
    stated: dict[str, Any] = {
        "name": "tidy",
        "description": "Tidies up.",
        "params": RetargetParams,
        "implementation": "tidy:run",
        "version": 1,
        "outputs": {},
    }
    return KindDeclaration(**(stated | fields))


TIDY = declare()


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[EntryPoint]]:
    """Entry points of other packages; the test adds them to the list."""
    entries: list[EntryPoint] = []
    monkeypatch.setattr(job_kinds, "entry_points", lambda group: [e for e in entries if e.group == group])
    job_kinds.job_kinds.cache_clear()
    yield entries
    job_kinds.job_kinds.cache_clear()


def entry(value: str) -> EntryPoint:
    return EntryPoint("tidy", value, job_kinds.ENTRY_POINT_GROUP)


def test_every_kind_describes_itself_with_a_json_schema() -> None:
    for kind in BUILT_IN:
        document = kind.document()
        assert document.params_schema["type"] == "object"
        assert document.name == kind.name
    assert find_kind("retarget").fan_out == "clips"


def test_a_kind_that_counts_its_tasks_says_who_gathers_them_and_spreads_no_input() -> None:
    with pytest.raises(ValueError, match="declare either both of task_count and gathering"):
        declare(task_count=lambda _params: 2)
    clips = {"clips": InputSpec(kind=Kind.CLIP, many=True)}
    with pytest.raises(ValueError, match="not both"):
        declare(task_count=lambda _params: 2, gathering="tidy:gather", inputs=clips, fan_out="clips")
    assert declare(task_count=lambda _params: 2, gathering="tidy:gather").document().gathers


@pytest.mark.parametrize(
    "wrong", [{"in_place": "x"}, {"newest_of": ("x",)}, {"named_after": "x"}, {"never_cached_without": ("x",)}]
)
def test_what_a_kind_says_of_its_results_names_parameters_and_inputs_it_has(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="'x'"):
        declare(**wrong)


def test_an_unknown_kind_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownKindError, match="retarget"):
        find_kind("xyz")


def test_other_distributions_add_kinds(installed: list[EntryPoint]) -> None:
    installed.append(entry(f"{__name__}:TIDY"))
    sys.modules[__name__] = sys.modules.get(__name__) or __import__("types").ModuleType(__name__)
    vars(sys.modules[__name__])["TIDY"] = TIDY
    assert find_kind("tidy") is TIDY


@pytest.mark.parametrize(
    ("value", "error"),
    [("marey_schemas.queue.job_kinds:IMPORT", ValueError), ("marey_schemas.queue.job_kinds:BUILT_IN", TypeError)],
)
def test_a_name_that_is_taken_or_a_thing_that_is_no_kind_is_refused(
    installed: list[EntryPoint], value: str, error: type[Exception]
) -> None:
    installed.append(entry(value))
    with pytest.raises(error, match="entry point"):
        job_kinds.job_kinds()
    assert IMPORT.name == "import"


def test_a_fan_out_needs_an_input_of_many_items() -> None:
    with pytest.raises(ValueError, match="fan_out"):
        declare(fan_out="clips")
    with pytest.raises(ValueError, match="fan_out"):
        declare(fan_out="clips", inputs={"clips": InputSpec(kind=Kind.CLIP)})
    with pytest.raises(ValueError, match="batch_size"):
        declare(batch_size=0)


def test_the_declarations_import_no_numeric_code() -> None:
    numeric = ("scipy", "numba", "marey_motion")
    code = f"import sys, marey_schemas.queue.job_kinds; print([name for name in {numeric} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
