"""Callbacks: watch the training loop; they may write files but never change training."""
