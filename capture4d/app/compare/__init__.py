"""What gives a garment its surface, compared on the same held-out frames."""
