"""How precisely a skin measures a touch, and where to put its sensors."""
