#!/bin/sh
# Batch script of a worker. The arguments are the command; the name of the worker comes from Slurm, so that a task that
# Slurm runs again keeps its name. The worker replaces the shell and so receives the signals for the batch step.
exec "$@" --name "$SLURM_JOB_NAME-$SLURM_ARRAY_TASK_ID"
