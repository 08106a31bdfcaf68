"""Readings as signals: what a device does to them, and what is measured on them."""
