"""Graph embeddings without training, and what they tell of a touch."""
