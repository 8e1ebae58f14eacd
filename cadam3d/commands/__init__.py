"""Commands: one module for each command of the command line, and the parts that they share."""
