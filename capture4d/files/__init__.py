"""One value, one file: arrays, records, pictures; whole or not there at all, and errors name the file and the line."""
