"""Where we look: samplers of training cameras."""
