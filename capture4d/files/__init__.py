"""One value, one file: meshes, arrays, records. Whole or not there at all; errors name the file and the line."""
