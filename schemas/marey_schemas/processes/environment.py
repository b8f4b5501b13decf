"""Environment of child processes: the variables that they need, and no secrets.

The environment of a server or worker may contain the address of the database with its password, and tokens. A child
gets only the variables that this module lists, and those that its parent adds.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from marey_schemas.queue.own_pods import IMAGE_VARIABLE
from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE
from marey_schemas.queue.worker_protocol import FAULT_VARIABLE

PASSED_ON = frozenset(
    {
        "HOME", "LANG", "LANGUAGE", "LD_LIBRARY_PATH", "MPLCONFIGDIR", "PATH", "SSL_CERT_DIR", "SSL_CERT_FILE",
        "SYSTEMROOT", "TEMP", "TMP", "TMPDIR", "TZ", "VIRTUAL_ENV", "XDG_CACHE_HOME",
    }
)  # fmt: skip
"""Variables that are passed on: the places of programs, caches, temporary files and certificates, and the language."""
PASSED_ON_PREFIXES = ("CUDA_", "KMP_", "LC_", "MKL_", "NUMBA_", "OMP_", "OPENBLAS_", "PYTHON")
"""Prefixes of further variables that are passed on: settings of the interpreter and of numeric libraries."""
EXTRA_VARIABLE = "MAREY_CHILD_VARIABLES"
"""Variable that lists further variables to pass on, separated by commas."""
OWN_VARIABLES = frozenset(
    {EXTRA_VARIABLE, FAULT_VARIABLE, IMAGE_VARIABLE, REPOSITORIES_VARIABLE, "MAREY_LOG_FORM", "MAREY_LOG_LEVEL"}
)
"""Marey's own variables that are passed on; none is a secret."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that limit the threads of numeric libraries."""


def clean_environment(source: Mapping[str, str] | None = None, *, threads: int | None = None) -> dict[str, str]:
    """Return the variables of `source` (default: of this process) that child processes get.

    `threads` limits the threads of those numeric libraries for which `source` sets no limit.
    """
    source = os.environ if source is None else source
    extra = {name.strip() for name in source.get(EXTRA_VARIABLE, "").split(",")}
    passed_on = PASSED_ON | OWN_VARIABLES | extra
    kept = {name: text for name, text in source.items() if name in passed_on or name.startswith(PASSED_ON_PREFIXES)}
    return (thread_limits(threads) if threads is not None else {}) | kept


def thread_limits(threads: int) -> dict[str, str]:
    """Return the variables that limit numeric libraries to a number of threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(threads))
