"""Jobs in pods of their own: the labels of such jobs, and the container images that scripts name."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated

from pydantic import AfterValidator

OWN_POD_LABEL = "marey/own-pod"
"""Label of jobs that run in a pod of their own. The server sets it; only a pod that runs one job has it."""
OWN_POD_VALUE = "yes"
GPUS_LABEL = "marey/gpus"
"""Label of jobs that need graphics processors; its value is their number."""
MOST_GPUS = 64

REFUSED_STATUS = 42
"""Exit status of a worker in a pod for a single job if the server refuses the worker; a restart would not help."""

IMAGE_VARIABLE = "MAREY_SCRIPT_IMAGE"
"""Environment variable with the image in which a worker runs; the launcher sets it if a script names an image."""


def with_digest(image: str) -> str:
    """Return `image`, the name of a container image. Raises `ValueError` if it does not end in a digest."""
    if len(image) > 500 or re.fullmatch(r"[A-Za-z0-9][\w.:/-]*@sha256:[0-9a-f]{64}", image, re.ASCII) is None:
        raise ValueError("the image must be named by its digest, as in registry.example.org/marey-worker@sha256:...")
    return image


Image = Annotated[str, AfterValidator(with_digest)]
"""Name of a container image with its digest."""


def is_allowed_image(image: str, allowed: Iterable[str]) -> bool:
    """Return whether a list of allowed images contains an image.

    An entry is an image with its digest, the name of a repository (all its digests), or a prefix that ends in `/`.
    """
    repository = image.partition("@")[0]
    return any(one in (image, repository) or (one.endswith("/") and image.startswith(one)) for one in allowed)
