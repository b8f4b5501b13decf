"""Async client: classes with the names and methods of the SDK, which run the SDK in threads.

The modules `calls`, `counterparts`, `interruption` and `sockets` are written by hand. `make docs` writes all other
modules from the SDK.
"""
