"""Points of scans that tracking reads: how many there are, which, and kept for the next stage."""
