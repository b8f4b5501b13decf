"""Entry point of `python -m marey_worker`."""

from marey_worker.commands import main

main()
