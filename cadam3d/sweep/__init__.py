"""A sweep: many trains, each a process of its own, and one table. The folder remembers what is done."""
