"""Meshes that move, as other tools' files hold them: USD, Alembic, point caches, a mesh a frame; and back."""
