"""cadam3d: a sentence in, 3D Gaussians out, densified where the gradient drifts consistently (CAdam)."""

__version__ = "0.1.0"
