"""Between an open skin and a set of touches: windows, labels, their file. No options (docs/adr/0006)."""
