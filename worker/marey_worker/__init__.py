"""Claims jobs, runs them in child processes, and writes the results back through the client."""
