"""Arrays and documents as bytes: JSON, MessagePack, BSON, and the block codec of stored arrays."""
