"""Sweeps: many trainings, each in a separate process, and one table. The folder records their progress."""
