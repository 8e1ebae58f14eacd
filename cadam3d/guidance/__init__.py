"""Objectives: how the prediction of a prior becomes a gradient."""
