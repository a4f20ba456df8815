"""Photographs of a board in, a rig out; and which camera has moved since."""
