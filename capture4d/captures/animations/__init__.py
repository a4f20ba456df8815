"""A learned garment in every frame of a motion, as files, and how far its poses are from those that were learned."""
