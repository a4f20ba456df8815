"""One class a command: options, help, and one call."""
