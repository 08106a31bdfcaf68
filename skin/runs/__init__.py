"""Configuration, training, and finished runs and models."""
