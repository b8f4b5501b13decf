"""Where workers run: beside the server, or on a cluster."""
