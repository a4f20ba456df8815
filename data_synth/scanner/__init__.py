"""The virtual rig: rays, speckle, noise, fusion."""
