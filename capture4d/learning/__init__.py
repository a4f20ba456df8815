"""Regression and networks that several wings learn with: arrays and tensors in, arrays and tensors out."""
