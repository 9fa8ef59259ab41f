"""Sweeps: which trainings there are (``plan``), who runs them (``engines``), what came out (``results``)."""
