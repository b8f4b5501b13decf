"""Kinds of jobs: each module implements one kind with the function `run(context, params)`."""
