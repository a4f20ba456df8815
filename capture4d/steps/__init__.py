"""Stages as functions, which `capture4d.pipeline` hands on under one name."""
