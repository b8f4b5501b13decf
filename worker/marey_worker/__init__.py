"""Worker: claims jobs, runs them in child processes, and sends the results to the server through the client."""
