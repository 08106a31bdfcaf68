"""From touches to predictions: features, representations, networks, learners."""
