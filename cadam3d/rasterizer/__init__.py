"""Differentiable rasterizers, which render Gaussians."""
