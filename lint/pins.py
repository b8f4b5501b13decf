"""Pins: the version and the hashes of every package that is installed, in one file for each layer of packages.

`python -m lint.pins [--upgrade | --upgrade-package NAME]` resolves `pyproject.toml` again and writes the files. Each
file includes the file of the layer below, so that every version is written in one file only. A version has the hashes
of its files for all platforms.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FOLDER = "pins"
BELOW = {
    "build": None, "all": "build", "traces": "all", "kubernetes": "traces", "dev": "kubernetes", "bench": "dev",
    "audit": "dev",
}  # fmt: skip
"""Names of layers of packages, each with the name of the layer below, which it extends.

`build` is the build backend; the other layers are extras of `pyproject.toml`.
"""
_PIN = re.compile(
    r"(?P<name>[a-z0-9][a-z0-9.-]*)(?:\[[^\]]*\])?==(?P<version>[^\s;\\]+)[^\n]*"
    r"(?:\n    --hash=sha256:[0-9a-f]{64}[^\n]*)*"
)


def pins_in(text: str) -> dict[str, str]:
    """Return the pins in a file of requirements: names, each with its versions, markers and hashes."""
    pins: dict[str, str] = {}
    for match in _PIN.finditer(text):
        pins[match["name"]] = f"{pins[match['name']]}\n{match[0]}" if match["name"] in pins else match[0]
    return pins


def layers_of(layer: str | None) -> Iterator[str]:
    """Yield a layer and the layers below it."""
    while layer is not None:
        yield layer
        layer = BELOW[layer]


def requirements_of(layer: str, pyproject: dict[str, Any]) -> list[str]:
    """Return the requirements of a layer and of the layers below it."""
    build: list[str] = pyproject["build-system"]["requires"]
    return [*build, *(f"{ROOT}[{extra}]" for extra in layers_of(layer) if extra != "build")]


def split(every: dict[str, str], needed: dict[str, set[str]]) -> dict[str, list[str]]:
    """Return the names of packages by layer: a package is in the highest layer shared by all layers that need it."""
    homes: dict[str, list[str]] = {layer: [] for layer in BELOW}
    for name in sorted(every):
        users = [list(layers_of(layer)) for layer, names in needed.items() if name in names]
        homes[next(layer for layer in users[0] if all(layer in user for user in users))].append(name)
    return homes


def with_extras(pin: str, form: str) -> str:
    """Return `pin` with the extras that the package has in `form`, another pin of the same package."""
    return form.partition("==")[0] + pin[pin.index("==") :]


def further_extras(
    layer: str, every: dict[str, str], forms: dict[str, dict[str, str]], homes: dict[str, list[str]]
) -> list[str]:
    """Return pins of packages that a lower layer pins, but that this layer needs with further extras.

    pip does not accept a pin without these extras. A pin with these extras cannot be in a lower layer, because the
    lower layer does not pin the packages that the extras need.
    """
    lower = list(layers_of(BELOW[layer]))
    pins = []
    for name, form in sorted(forms[layer].items()):
        written = {forms[one][name].partition("==")[0] for one in lower if name in forms[one]}
        if any(name in homes[one] for one in lower) and written and form.partition("==")[0] not in written:
            pins.append(with_extras(every[name], form))
    return pins


def main(options: Sequence[str]) -> int:
    """Resolve all layers together and write their files; return the exit status."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    files = {layer: ROOT / FOLDER / f"{layer}.txt" for layer in BELOW}
    known = "\n".join(path.read_text("utf-8") for path in files.values() if path.exists())
    wanted = [one for layer in BELOW for one in requirements_of(layer, pyproject)]
    every = pins_in(_resolve(wanted, known, "--generate-hashes", *options))
    chosen = "\n".join(every.values())
    forms = {layer: pins_in(_resolve(requirements_of(layer, pyproject), chosen)) for layer in BELOW}
    homes = split(every, {layer: set(names) for layer, names in forms.items()})
    for layer, names in homes.items():
        below = BELOW[layer]
        pins = [with_extras(every[name], forms[layer].get(name, every[name])) for name in names]
        pins += further_extras(layer, every, forms, homes)
        lines = ["# Written by `make pins`.", *([f"-r {below}.txt"] if below else []), *pins]
        files[layer].write_text("\n".join(lines) + "\n", "utf-8")
    return 0


def _resolve(wanted: Sequence[str], known: str, *options: str) -> str:
    """Return the pins of requirements as uv resolves them, with the versions in `known` wherever they still fit."""
    with tempfile.TemporaryDirectory() as folder:
        pins, requirements = Path(folder) / "pins.txt", Path(folder) / "wanted.in"
        pins.write_text(re.sub(r"(?m)^(-r|#).*\n", "", known), "utf-8")
        requirements.write_text("\n".join(dict.fromkeys(wanted)), "utf-8")
        target = ["--universal", "--python-version", "3.11", "--output-file", str(pins), str(requirements)]
        # pip resolves `name[extra]` apart from `name`, and accepts only pins of the names that packages require.
        form = ["--quiet", "--no-header", "--no-annotate", "--no-strip-extras"]
        subprocess.run([sys.executable, "-m", "uv", "pip", "compile", *form, *options, *target], check=True)
        return pins.read_text("utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
