"""Cages of curves on a surface, what they carry into the patches between them, and cloth shrunk onto a body by one."""
