"""Lock around `import` statements of the motion library, which the server loads only when a request needs it."""

from __future__ import annotations

import gc
import sys
import threading


class Loading:
    """Lock held by every thread of the server while it imports modules of the motion library.

    Python locks every module while it is imported. Suppose that one thread imports a package while another imports a
    module of that package. Then each can wait for a lock that the other holds, and Python ends one of the imports with
    an error. With this lock, only one thread imports at a time. Child processes need no lock, because they import in a
    single thread.

    After an import that has loaded modules, the lock excludes all existing objects from garbage collection. Nearly all
    of these objects belong to modules, which live as long as the process. A search of them stops all threads for 0.2 s.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._modules = 0

    def __enter__(self) -> None:
        self._lock.acquire()
        self._modules = len(sys.modules)

    def __exit__(self, *_error: object) -> None:
        if len(sys.modules) != self._modules:
            self._modules = len(sys.modules)
            gc.collect()
            gc.freeze()
        self._lock.release()


LOADING = Loading()
