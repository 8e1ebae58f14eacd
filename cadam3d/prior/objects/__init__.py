"""prior=objects: an exact diffusion model of a folder of textured meshes."""
