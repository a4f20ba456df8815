"""The synthetic 4D scanner: simulated cloth on a parametric body, scanned by a virtual rig."""
