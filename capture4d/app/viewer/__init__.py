"""A take or an animation in the browser, frame by frame, live while it is being made."""
