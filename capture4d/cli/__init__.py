"""The command line: one class a command, and one line for whatever goes wrong."""
