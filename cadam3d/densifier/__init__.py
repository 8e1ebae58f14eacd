"""Densifiers: when Gaussians are added, and which; how they are added and removed is in ``refine.py``."""
