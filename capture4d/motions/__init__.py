"""Motions from elsewhere: their files, and from one skeleton to another."""
