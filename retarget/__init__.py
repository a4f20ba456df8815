"""The garment as a model: blendshapes, pose regression, new bodies and styles."""
