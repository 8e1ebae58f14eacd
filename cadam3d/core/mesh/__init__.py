"""The surface of Gaussians: their density on a grid, a triangle mesh around it, and normals as colours."""
