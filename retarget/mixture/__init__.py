"""A garment as a function of pose, shape and style, learned from drapes: TailorNet, and what does better here."""
