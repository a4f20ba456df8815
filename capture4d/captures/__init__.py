"""The two folders: CAPTURE, which a lab hands in, and WORK, which the stages fill."""
