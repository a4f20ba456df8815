"""Stages as functions, which the pipeline hands on."""
