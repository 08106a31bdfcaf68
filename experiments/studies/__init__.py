"""Comparisons of configurations: variants, trials, paired differences, tables and figures."""
