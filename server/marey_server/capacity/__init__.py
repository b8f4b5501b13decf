"""Capacity planning: measured costs, the needs of an amount of work, and a simulation of the queue of jobs."""
