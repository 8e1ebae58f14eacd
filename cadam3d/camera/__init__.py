"""Samplers of training cameras."""
