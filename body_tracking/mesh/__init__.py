"""The mesh system: a personal body mesh fitted to depth images and wrist sensors (Jatesiktat 2018)."""
