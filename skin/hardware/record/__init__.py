"""Sessions: raw frames and gestures of a real skin, recorded to disk and read back."""
