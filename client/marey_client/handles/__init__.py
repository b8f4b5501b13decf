"""Handles of items, pipelines and streams: objects that represent things of a server, and ask it when called."""
