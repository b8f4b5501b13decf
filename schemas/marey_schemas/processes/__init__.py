"""Child processes: a clean environment, messages as bytes, limits, and the end by force. Messages are never pickled."""
