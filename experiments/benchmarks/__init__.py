"""What ``make bench`` measures, one module per kind of figure."""
