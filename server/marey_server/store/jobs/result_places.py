"""Checks of the paths at which a job will store its results, made before the job is queued.

The worker checks again for each clip. But it cannot compare all inputs, because each task of a job knows only its own
share of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from marey_schemas.queue.job_params import ImportParams
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_server.errors import InvalidProblem
from marey_server.store import collections
from marey_server.store.jobs.inputs import Pin, PinnedInputs


class Clash(NamedTuple):
    """Conflict between the paths of a job's results; `place` is the JSON Pointer to the field that causes it."""

    place: str
    code: str
    detail: str


def find_clash(kind: KindDeclaration, params: Any, pins: PinnedInputs, into: str) -> Clash | None:
    """Return a conflict that prevents a job from storing its results at their paths, or None.

    Conflicts are: `into` and the parameters do not determine the place of the results; a path is too long; two results
    have the same path; or a result would replace another input. Paths are not compared if an input is the result of
    another job, because this result may not exist yet.
    """
    unclear = kind.unclear_place(params, into) if kind.unclear_place is not None else None
    if unclear is not None:
        return Clash("/into", "ambiguous-place", f"It is not clear where results should go: {unclear}.")
    if (long := _too_long(kind, pins, into)) is not None:
        return Clash("/into", *long)
    if kind.named_after is None or any("job" in pin for many in pins.values() for pin in many):
        return None
    found = _same_name(pins.get(kind.named_after, [])) or _over_another_input(kind, params, pins, into)
    return None if found is None else Clash(f"/inputs/{kind.named_after}", *found)


def result_folders(kind: KindDeclaration, params: Mapping[str, Any], pins: PinnedInputs, into: str) -> list[str]:
    """Return the folders of a job's results, as far as they are known before the job runs.

    If results are stored where the inputs are, and other jobs create these inputs, only `into` is known, or nothing.
    When the results are published, their real folders are checked again.
    """
    if named := pins.get(kind.named_after or "", ()):
        in_place = kind.in_place is not None and params.get(kind.in_place)
        stays = in_place or not (into or kind.inputs[kind.named_after or ""].many)  # as a tree in its model
        known = [pin for pin in named if "job" not in pin]
        folders = {pin["collection"] if stays else _path(into, _folder(pin)) for pin in known}
        return sorted(folders | ({into} if into and len(known) < len(named) else set()))
    return [_path(into, params.get("collection", "") if issubclass(kind.params, ImportParams) else "")]


def _too_long(kind: KindDeclaration, pins: PinnedInputs, into: str) -> tuple[str, str] | None:
    """Return the code and the text of the conflict if the path of a result would be too long; None if not."""
    kept = [pin for name, spec in kind.inputs.items() if spec.many for pin in pins.get(name, ()) if "job" not in pin]
    for folder in sorted({"", *map(_folder, kept)}) if into else ():
        try:
            collections.check_length(_path(into, folder))
        except InvalidProblem as error:
            return error.error_code, f"The results cannot go to {_path(into, folder)}. {error.detail}"
    return None


def _same_name(named: list[Pin]) -> tuple[str, str] | None:
    counts = Counter((_folder(pin), pin["name"]) for pin in named)
    for (folder, name), count in counts.most_common(1):
        if count > 1:
            detail = f"{count} results would have the path {_path(folder, name)}; give each input at one revision only."
            return "same-name", detail
    return None


def _over_another_input(
    kind: KindDeclaration, params: Any, pins: Mapping[str, list[Pin]], into: str
) -> tuple[str, str] | None:
    """Return the code and the text of the conflict if the result for one input would replace another input.

    Returns None if there is no such conflict.
    """
    named = pins.get(kind.named_after or "", [])
    if kind.in_place is not None and getattr(params, kind.in_place):
        return None
    made = set(kind.outputs.values())
    read = {
        (pin["kind"], _path(pin["collection"], pin["name"])): pin["item"]
        for many in pins.values()
        for pin in many
        if pin["kind"] in made
    }
    for pin in named:
        place = _path(into, _folder(pin), pin["name"] + getattr(params, "suffix", ""))
        if read.get((pin["kind"], place), pin["item"]) != pin["item"]:
            detail = (
                f"The result of {_path(pin['collection'], pin['name'])} would replace {place}, which is also an "
                "input of the job; send results into another folder, or give another suffix."
            )
            return "own-input", detail
    return None


def _folder(pin: Pin) -> str:
    """Return the folder of an input's result below `into`."""
    return str(pin.get("below", pin["collection"]))


def _path(*names: str) -> str:
    """Join the names that are not empty to a path."""
    return "/".join(filter(None, names))
