"""Viewer: Gaussians in a browser, drawn by one script of our own from one binary snapshot."""
