"""Entry point of `python -m marey_worker`."""

from marey_schemas.processes.memory import loading_modules

with loading_modules():
    from marey_worker.commands import main

main()
