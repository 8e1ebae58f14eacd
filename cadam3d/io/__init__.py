"""Floor 0: one file per format on disk."""
