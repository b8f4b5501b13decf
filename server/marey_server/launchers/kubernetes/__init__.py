"""Launcher that runs workers as Jobs of a Kubernetes cluster."""
