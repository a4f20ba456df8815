"""How work is run: stage folders that resume, worker processes."""
