"""Islands of UVs: what a map shows where two of them share an edge of the cloth."""
