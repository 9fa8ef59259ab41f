"""Learning, evaluating, and what a run writes down."""
