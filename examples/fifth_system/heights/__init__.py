"""A system that another package brings: how tall each filtered skeleton stands."""
