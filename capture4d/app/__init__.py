"""The composition root: command line, pipeline, report and pictures."""
