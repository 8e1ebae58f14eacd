"""Live: the page of ``cadam3d view``, the server behind it, and what both show of a run or a file."""
