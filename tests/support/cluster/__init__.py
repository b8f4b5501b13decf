"""Stub of a Kubernetes cluster for tests: its API over HTTP, its controllers, and pods that are local processes."""
