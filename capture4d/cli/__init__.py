"""The command line: arguments to one command, and one line for whatever goes wrong."""
