"""Metrics: numbers about an asset, such as its quality and its size."""
