"""Posterior of contacts: where, how hard, how sure."""
