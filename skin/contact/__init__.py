"""What pressure an object makes where it touches the skin."""
