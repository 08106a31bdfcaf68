"""Readings as signals: device imperfections, resampling, contact detection, features."""
