"""What the worker can do: one module per kind of job, each with `run(context, params)`."""
