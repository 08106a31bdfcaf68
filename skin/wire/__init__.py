"""What is between a wire and its frames: protocol, decoder, reader. No options (docs/adr/0006)."""
