"""One value, one file: meshes, arrays, records; whole or not there at all, and errors name the file and the line."""
