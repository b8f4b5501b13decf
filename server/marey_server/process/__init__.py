"""The server process: settings, shared services, threads, logs, and periodic work."""
