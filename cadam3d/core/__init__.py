"""Floor 0: the data types that all other packages share. Imports torch and nothing of ours."""
