"""Triangle meshes as arrays: normals, edges, borders, nearest points, UVs."""
