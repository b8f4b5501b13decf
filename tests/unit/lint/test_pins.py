"""Pins: every installed package has one version with hashes, and the pin files contain what the extras require."""

import re
import tomllib
from importlib.metadata import distributions
from typing import Any

import pytest
from lint.pins import BELOW, FOLDER, ROOT, layers_of, pins_in, split
from packaging.requirements import Requirement
from tests.support.present import present

PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
FILES = {layer: (ROOT / FOLDER / f"{layer}.txt").read_text("utf-8") for layer in BELOW}
PINS = {layer: pins_in(text) for layer, text in FILES.items()}


def name_of(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", present(re.match(r"[\w.-]+", requirement))[0]).lower()


def required(extra: str) -> set[str]:
    """Return the names of the packages that an extra requires, including those of extras that it includes."""
    names: set[str] = set()
    for one in PYPROJECT["project"]["optional-dependencies"][extra]:
        included = re.match(r"marey\[(.*)\]", one)
        names |= set().union(*map(required, included[1].split(","))) if included else {name_of(one)}
    return names


def test_no_tornado_is_allowed_that_leaves_cancelled_requests_without_an_answer() -> None:
    """A stopping server cancels requests; before 6.6, Tornado did not answer these, and logged their tracebacks."""
    wanted = map(Requirement, PYPROJECT["project"]["optional-dependencies"]["server"])
    (tornado,) = (one for one in wanted if one.name == "tornado")
    assert "6.5.10" not in tornado.specifier
    assert "6.6" in tornado.specifier


def test_every_pin_has_a_version_and_a_hash() -> None:
    unhashed = [name for pins in PINS.values() for name, text in pins.items() if "--hash=sha256:" not in text]
    assert unhashed == []
    assert sum(map(len, PINS.values())) > 100


def test_a_package_is_pinned_in_one_file_and_elsewhere_only_with_further_extras() -> None:
    texts: dict[str, list[str]] = {}
    for name, text in [pin for pins in PINS.values() for pin in pins.items()]:
        texts.setdefault(name, []).append(text)
    for several in (texts[name] for name in texts if len(texts[name]) > 1):
        first, *others = (text.partition("==") for text in several)
        assert all(other[2] == first[2] for other in others), "the same version and hashes"
        assert all("[" in other[0] != first[0] for other in others)


@pytest.mark.parametrize("layer", [layer for layer in BELOW if layer != "build"])
def test_a_layer_pins_what_its_extra_requires(layer: str) -> None:
    pinned = {name for one in layers_of(layer) for name in PINS[one]}
    assert {*required(layer), *map(name_of, PYPROJECT["project"]["dependencies"])} <= pinned
    assert FILES[layer].startswith(f"# Written by `make pins`.\n-r {BELOW[layer]}.txt\n")


def test_a_pin_names_the_extras_that_other_packages_require() -> None:
    """Without the extra in the pin, pip finds no pin for `coverage[toml]` when a newer version is published."""
    pinned = {name: text for pins in PINS.values() for name, text in pins.items()}
    missing = []
    for package in filter(lambda one: name_of(one.name) in pinned, distributions()):
        for one in map(Requirement, package.requires or ()):
            if one.extras and (one.marker is None or one.marker.evaluate({"extra": ""})):
                missing += [str(one) for extra in one.extras if f"[{extra}" not in pinned[name_of(one.name)]]
    assert missing == []


def test_the_build_backend_has_the_pinned_version() -> None:
    assert all(one in FILES["build"] for one in PYPROJECT["build-system"]["requires"])
    assert all(re.fullmatch(r"[\w-]+==[\w.]+", one) for one in PYPROJECT["build-system"]["requires"])


def test_no_pin_names_a_host() -> None:
    assert [layer for layer, text in FILES.items() if "//" in text or "--index" in text] == []


def test_a_package_belongs_to_the_highest_layer_below_all_that_need_it() -> None:
    needed = {"all": {"a"}, "dev": {"a", "b"}, "bench": {"a", "b", "c", "d"}, "audit": {"a", "b", "c", "e"}}
    homes = split(dict.fromkeys("abcde", ""), needed)
    unused: dict[str, list[str]] = {"build": [], "traces": [], "kubernetes": []}
    assert homes == unused | {"all": ["a"], "dev": ["b", "c"], "bench": ["d"], "audit": ["e"]}


def test_a_pin_keeps_all_its_versions_and_hashes() -> None:
    older, newer = (
        f"x-y=={number} \\\n    --hash=sha256:{digit * 64}" for number, digit in (("1.0", "0"), ("2.0", "1"))
    )
    two = f"{older}\n{newer}"
    assert pins_in(f"# note\n-r all.txt\n{two}\n") == {"x-y": two}


def test_a_pin_may_have_extras() -> None:
    text = f"x-y[toml]==1.0 \\\n    --hash=sha256:{'0' * 64}"
    assert pins_in(text) == {"x-y": text}
