"""Capacity on paper: measured costs, what a given amount of work needs, and a simulation of the queue of jobs."""
