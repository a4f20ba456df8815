"""Sets of drapes of many styles on many people: which pairs are simulated in many poses, and which are kept to test."""
