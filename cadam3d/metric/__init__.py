"""How good is it: numbers about an asset."""
