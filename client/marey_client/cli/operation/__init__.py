"""Commands that measure and test a server as a whole: load tests, computed capacity, and fault injection."""
