"""The pressure that an object makes where it touches the skin."""
