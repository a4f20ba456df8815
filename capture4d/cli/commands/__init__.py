"""The commands: a dataclass each, whose fields are its options, and whose call is one call of the pipeline."""
