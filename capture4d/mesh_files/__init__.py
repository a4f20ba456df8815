"""Mesh files with their colours and textures: obj, ply and glb in and out, gltf, stl and off in."""
