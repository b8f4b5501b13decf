"""Upkeep of blobs in object storage, outside of requests: moves, checks, and deletion of objects without rows."""
