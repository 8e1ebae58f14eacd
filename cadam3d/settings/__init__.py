"""Settings: read command lines, compose the configuration, and print help about both."""
