"""Shell completion: scripts for shells, the completion function of each parameter, and requests to the server.

A shell runs `marey` with the environment variable `_MAREY_COMPLETE`. `marey` prints no errors then: if anything fails,
for example because the server is down, the shell shows no suggestions.
"""
