"""Answers of older servers: a field that is added to an answer has a default, so that new clients read old answers.

`answer_fields.txt` lists the required fields of each answer. `python -m tests.unit.schemas.test_answer_fields` adds the
answers that are missing in the file. It never adds a field to an answer that is there.
"""

import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import marey_schemas
from marey_schemas.access import ProjectQuotasInUse
from marey_schemas.base import Answer

LIST = Path(__file__).with_name("answer_fields.txt")


def answers() -> dict[str, type[Answer]]:
    """Return the answers that `marey_schemas` declares, by the names of their classes, in order."""
    for module in pkgutil.walk_packages(marey_schemas.__path__, "marey_schemas."):
        importlib.import_module(module.name)
    found = {one.__name__: one for one in _below(Answer) if one.__module__.startswith("marey_schemas.")}
    return dict(sorted(found.items()))


def _below(base: type[Answer]) -> Iterator[type[Answer]]:
    for one in base.__subclasses__():
        yield one
        yield from _below(one)


def required(one: type[Answer]) -> list[str]:
    return [name for name, field in one.model_fields.items() if field.is_required()]


def listed() -> dict[str, list[str]]:
    rows = (line.split() for line in LIST.read_text().splitlines())
    return {name: fields for name, *fields in rows}


def test_a_field_that_is_added_to_an_answer_has_a_default() -> None:
    known = listed()
    added = {name: sorted(set(required(one)) - set(known[name])) for name, one in answers().items() if name in known}
    assert {name: fields for name, fields in added.items() if fields} == {}, "give these fields a default"


def test_no_answer_lacks_a_field_that_clients_require() -> None:
    current, known = answers(), listed()
    assert sorted(known) == list(current), "run this module to list new answers; delete lines of old ones"
    lacking = {name: sorted(set(fields) - set(current[name].model_fields)) for name, fields in known.items()}
    assert {name: fields for name, fields in lacking.items() if fields} == {}, "older clients need these fields"


def test_quotas_of_a_server_that_does_not_report_running_jobs_are_read() -> None:
    quota = {"used": 1, "allowed": 2}
    assert ProjectQuotasInUse.model_validate({"items": quota, "stored_bytes": quota}).running_jobs is None


if __name__ == "__main__":
    lines = {name: required(one) for name, one in answers().items()} | (listed() if LIST.exists() else {})
    LIST.write_text("".join(f"{' '.join([name, *fields])}\n" for name, fields in sorted(lines.items())))
