"""When and where to grow."""
