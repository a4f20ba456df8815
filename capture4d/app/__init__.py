"""Pages, pictures and figures: what people see of a work folder."""
