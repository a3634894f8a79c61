"""An example of a system in another package: the height of the filtered skeleton."""
