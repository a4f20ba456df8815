"""Cards: what a model or an export was made from, under which licences, and how good it is."""
