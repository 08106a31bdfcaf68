"""From surface pressure to true sensor readings: each module is one choice of ``simulator=``."""
