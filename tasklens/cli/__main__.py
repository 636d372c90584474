"""`python -m tasklens.cli`: the command line without its script, as torchrun starts it."""

from tasklens.cli.app import main

main()
