"""A garment mesh, or a part of the body, in; a template to register out."""
