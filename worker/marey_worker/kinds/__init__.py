"""Kinds of jobs: one module each, with `run(context, params)`."""
