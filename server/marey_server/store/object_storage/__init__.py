"""Blobs in object storage: the client, the backing, and the movement of bytes outside transactions."""
