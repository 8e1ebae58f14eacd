"""What we start from: initial Gaussians."""
