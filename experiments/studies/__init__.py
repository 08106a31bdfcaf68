"""Comparisons: what is varied, on what it is tried, and what follows; their tables and figures."""
