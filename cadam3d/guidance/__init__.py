"""How the opinion of a prior becomes a gradient."""
