"""A person as a skinned mesh: shape, pose, skin; where bodies come from."""
