"""`python -m lint`: check every rule, print each offence with its place, and fail if there is any."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from lint import (
    circles,
    class_names,
    constants,
    docstrings,
    folders,
    lengths,
    lists,
    migrations,
    small_modules,
    unused,
    wording,
)
from lint.exceptions import (
    EXCEPTIONS,
    apply_baseline,
    apply_exceptions,
    line_of,
    read_baseline,
    read_exceptions,
    shown,
    shrink_baseline,
)
from lint.sources import House, Offence, read_house

ROOT = Path(__file__).parent.parent
RULES: Mapping[str, Callable[[House], Iterator[Offence]]] = {
    "circles": circles.find,
    "folders": folders.find,
    "small_modules": small_modules.find,
    "class_names": class_names.find,
    "unused": unused.find,
    "lengths": lengths.find,
    "docstrings": docstrings.find,
    "lists": lists.find,
    "constants": constants.find,
    "migrations": migrations.find,
}
"""Rules by the names that `exceptions.toml` uses. The rule on wording is not included, because it has a baseline."""


def check(house: House, root: Path) -> Iterator[tuple[str, Offence]]:
    """Yield every offence that has no exception, with the name of its rule."""
    reasons = read_exceptions()
    for rule in reasons.keys() - RULES.keys():
        message = f"no rule is called {rule}; remove the table, or name one of {', '.join(RULES)}"
        yield "exceptions", Offence(EXCEPTIONS, line_of(f"[{rule}]", EXCEPTIONS), rule, message)
    for name, find in RULES.items():
        yield from ((name, one) for one in apply_exceptions(name, find(house), reasons.get(name, {})))
    yield from (("wording", one) for one in apply_baseline(wording.find(house), read_baseline(), root))


def main() -> int:
    """Print every offence; return the exit status, 1 if there are any.

    With `--shrink`, lower the counts in `wording.toml` to the present numbers instead.
    """
    parser = argparse.ArgumentParser(prog="python -m lint", description=__doc__)
    parser.add_argument(
        "--shrink", action="store_true", help="lower the counts in wording.toml to the present numbers of offences"
    )
    gc.disable()  # The syntax trees stay until the end; searching them for garbage takes a third of the time.
    house = read_house(ROOT)
    if parser.parse_args().shrink:
        shrink_baseline(wording.find(house), ROOT)
        return 0
    offences = list(check(house, ROOT))
    for rule, offence in offences:
        sys.stdout.write(f"{shown(offence.path, ROOT)}:{offence.line}: {rule}: {offence.message}\n")
    return 1 if offences else 0


if __name__ == "__main__":
    sys.exit(main())
