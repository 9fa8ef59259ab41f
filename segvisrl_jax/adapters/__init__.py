"""The environment in other libraries' terms: ``gymnasium`` and ``brax``."""
