"""How we see: differentiable rasterizers."""
