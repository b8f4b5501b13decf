"""Traces of requests and jobs: their place in HTTP headers, their spans, and the exporter of the extra `traces`."""
