"""Normal maps and offset images: the detail that the template cannot carry."""
