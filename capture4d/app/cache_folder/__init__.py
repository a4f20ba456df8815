"""What the user's cache folder keeps, which of it this version still uses, and what is removed on demand."""
