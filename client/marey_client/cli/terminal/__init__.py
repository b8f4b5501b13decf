"""Modules that all commands use: options, typed values, output, errors, and waiting for a job."""
