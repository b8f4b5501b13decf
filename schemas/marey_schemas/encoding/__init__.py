"""Encodings of arrays and documents: JSON, MessagePack, BSON, and the block codec of stored arrays."""
