"""A trained policy as one file that other programs can run: the step, its formats, its description, its check."""
