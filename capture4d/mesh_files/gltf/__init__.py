"""glTF 2.0, binary or not: a scene as one mesh with colours, and a mesh as a file."""
