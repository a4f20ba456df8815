"""A learned garment on a person who is posed with sliders or by a clip, live in the browser."""
