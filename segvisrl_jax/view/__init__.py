"""A browser page in which a person watches, steers and rearranges an episode."""
