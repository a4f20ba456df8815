"""glTF files, binary or not: a scene as one mesh with its base colours, and a mesh as a file."""
