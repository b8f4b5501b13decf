"""Shell completion: scripts for shells, the table of what completes which parameter, and questions to the server.

A shell runs `marey` with the environment variable `_MAREY_COMPLETE`. The answer is never an error: whatever fails, such
as a server that is down, the shell shows no suggestions.
"""
