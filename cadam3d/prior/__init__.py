"""What knows images: diffusion and flow models behind one interface."""
