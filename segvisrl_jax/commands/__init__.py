"""One module per command of ``segvisrl``: each parses its arguments (a dataclass) and calls the library."""
