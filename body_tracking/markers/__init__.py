"""Retro-reflective balls on rigid targets, seen by two or more infrared cameras (Gaschler 2011)."""
