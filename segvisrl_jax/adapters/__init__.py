"""The environment, and trained policies, in other libraries' terms."""
