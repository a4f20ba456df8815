"""What colours tell: light, materials, and which vertex is garment, paint or the rest."""
