"""From 4D scans of a clothed person to a garment that can be animated."""
