"""Handles: objects for items, pipelines and streams of a server, whose methods send requests."""
