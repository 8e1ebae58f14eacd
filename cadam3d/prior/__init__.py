"""Priors: diffusion and flow models of images behind one interface."""
