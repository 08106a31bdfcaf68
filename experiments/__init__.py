"""What this project runs with the package ``skin``: comparisons, laws of the mechanics, benchmarks."""
