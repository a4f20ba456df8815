"""Mesh files: obj, ply and glb, with their colours and textures, in and out."""
