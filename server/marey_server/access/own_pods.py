"""Rules by which a job gets a pod of its own, apart from the workers that run one job after another.

Such a job has the label `OWN_POD_LABEL`. Only the pod that was started for the job has this label, so no other worker
claims the job.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from marey_schemas.problems import FieldError
from marey_schemas.queue.jobs import JobCreate, Resources
from marey_schemas.queue.own_pods import GPUS_LABEL, MOST_GPUS, OWN_POD_LABEL, OWN_POD_VALUE, is_allowed_image
from marey_server.errors import InvalidProblem


@dataclass(frozen=True)
class PodRules:
    """Rules that decide whether a job gets a pod of its own.

    Parameters
    ----------
    memory_mb : memory limit in MiB; a job with a greater limit gets a pod of its own
    expected_s : duration in seconds; a job with a longer expected duration gets a pod of its own
    labels : labels, as name=value, that pods can have; a job with other labels gets no pod of its own
    images : images that scripts may name, see `is_allowed_image`
    """

    memory_mb: int
    expected_s: int
    labels: frozenset[str] = frozenset()
    images: tuple[str, ...] = ()

    def suit(self, resources: Resources) -> bool:
        """Return whether a job with these limits gets a pod of its own."""
        long = resources.expected_s is not None and resources.expected_s > self.expected_s
        return long or resources.memory_limit_mb > self.memory_mb


def labels_of_job(request: JobCreate, image: str | None, rules: PodRules | None, at: str) -> dict[str, str]:
    """Return the labels that a worker must have for a job, including those that the server sets.

    Parameters
    ----------
    request : request to submit the job; `at` is its JSON Pointer in the body, for errors
    image : image that the script of the job names, if any
    rules : None if the server starts no pods for single jobs

    Raises `InvalidProblem` if the number of graphics processors is not valid, or if the job needs an image that it
    cannot get.
    """
    labels = {name: text for name, text in request.labels.items() if name != OWN_POD_LABEL}
    if request.resources.gpus:
        labels[GPUS_LABEL] = str(request.resources.gpus)
    _require_number(labels.get(GPUS_LABEL), at)
    beyond = _labels_beyond(labels, rules)
    if image is not None:
        _require_image(image, rules, beyond, at)
    if rules is None or beyond:
        return labels
    asked = image is not None or GPUS_LABEL in labels or OWN_POD_LABEL in request.labels
    return {**labels, OWN_POD_LABEL: OWN_POD_VALUE} if asked or rules.suit(request.resources) else labels


def gpus_of(labels: Mapping[str, str]) -> int:
    """Return the number of graphics processors that a job with these labels needs."""
    return int(labels.get(GPUS_LABEL, "0"))


def _labels_beyond(labels: Mapping[str, str], rules: PodRules | None) -> list[str]:
    offered = frozenset() if rules is None else rules.labels
    given = (f"{name}={text}" for name, text in sorted(labels.items()) if name != GPUS_LABEL)
    return [label for label in given if label not in offered]


def _require_number(text: str | None, at: str) -> None:
    if text is not None and text not in map(str, range(1, MOST_GPUS + 1)):
        detail = f"The label {GPUS_LABEL} must be a number of graphics processors from 1 to {MOST_GPUS}."
        raise _invalid(f"{at}/labels", "bad-gpus", detail)


def _require_image(image: str, rules: PodRules | None, beyond: list[str], at: str) -> None:
    if rules is None:
        detail = (
            "The script names an image, but this server starts no pods for single jobs; its operator can change this "
            "with the setting `own_pods`."
        )
        raise _invalid(f"{at}/params/script", "no-own-pods", detail)
    require_allowed_image(image, rules, f"{at}/params/script")
    if beyond:
        detail = f"The script runs in a pod of its own, and no pod has the label {beyond[0]!r}; remove the label."
        raise _invalid(f"{at}/labels", "no-own-pods", detail)


def require_allowed_image(image: str, rules: PodRules | None, pointer: str) -> None:
    """Raise `InvalidProblem` at `pointer` if scripts may not run in an image."""
    if rules is None or not is_allowed_image(image, rules.images):
        detail = "This server does not allow the image; ask its operator to add it to `images` of `own_pods`."
        raise _invalid(pointer, "image-not-allowed", detail)


def _invalid(pointer: str, code: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, errors=[FieldError(pointer=pointer, code=code, detail=detail)])
