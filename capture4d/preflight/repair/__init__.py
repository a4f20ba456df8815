"""The take again, without what is safely repaired."""
