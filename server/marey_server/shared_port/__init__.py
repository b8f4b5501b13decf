"""Several server processes that share one port: the parent starts, watches and replaces them, and opens no database."""
