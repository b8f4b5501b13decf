"""Handles of items, pipelines and streams: objects that stand for something at the server and ask it when called."""
