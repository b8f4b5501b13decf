"""Information for operators: the workers, and the state of the queue and of stored data."""
