"""Async client: classes with the names and methods of the SDK, which run the SDK in threads.

The modules `calls`, `sockets` and `counterparts` are written by hand. `make docs` writes all others from the SDK.
"""
