"""What this project runs with the package ``skin``: comparisons, checks of the mechanics, benchmarks."""
