"""Who watches the loop: may look, may write files, may never change training."""
