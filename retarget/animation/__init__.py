"""A learned garment and a motion in, a registered sequence on any body out."""
