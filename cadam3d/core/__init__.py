"""Floor 0: the data everybody shares. Torch only; knows nobody."""
