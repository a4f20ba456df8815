"""Registered sequences of other tools on their way in, and how near they are to the truth."""
