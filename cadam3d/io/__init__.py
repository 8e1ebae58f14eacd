"""Files on disk: one module for each format, and for the folder of a run."""
