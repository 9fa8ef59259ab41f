"""The machine that this runs on: what is installed, what it has, how fast it is."""
