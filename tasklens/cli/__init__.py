"""The command line: a module for each group of commands; what they compute is elsewhere."""
