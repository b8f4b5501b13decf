"""Lock around `import` statements of the motion library, which the server loads only when a request needs it."""

from __future__ import annotations

import threading

LOADING = threading.RLock()
"""Held by every thread of the server while it imports modules of the motion library.

Python locks every module while it is imported. If one thread imports a package while another imports a module of that
package, each can wait for a lock that the other holds; Python then ends one of the imports with an error. With this
lock, only one thread imports at a time. Child processes need no lock, because they import in a single thread.
"""
