"""Handlers of HTTP requests, one module per resource.

A handler parses the request, checks access, calls a function of `store` or `motions`, and renders the answer.
"""
