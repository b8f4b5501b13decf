"""Blobs in object storage: the client, the movement of bytes outside transactions, garbage collection, migration."""
