"""`python -m tasklens.cli`: the command line without its script."""

from tasklens.cli.app import main

main()
