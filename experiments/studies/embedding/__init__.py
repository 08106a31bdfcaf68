"""Pretrained embeddings of sensor graphs, and what they know of a touch."""
