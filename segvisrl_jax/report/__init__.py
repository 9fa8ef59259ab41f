"""Figures and videos of runs, scenes and episodes."""
