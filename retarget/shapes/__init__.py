"""Registered frames in, a mean and its principal directions in the unposed space out."""
