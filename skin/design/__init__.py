"""What a skin can know, and where to put its sensors."""
