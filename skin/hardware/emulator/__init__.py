"""A skin without hardware: gestures in real time behind a port. No options (docs/adr/0006)."""
