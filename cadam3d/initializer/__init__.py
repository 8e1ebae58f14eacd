"""Initializers: the Gaussians that training starts from."""
