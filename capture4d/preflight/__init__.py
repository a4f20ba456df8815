"""What is wrong with a take, before a night is spent on it."""
