"""`python -m marey_client.cli`: the `marey` command for systems where its script is not on the path."""

from marey_client.cli import main

main()
