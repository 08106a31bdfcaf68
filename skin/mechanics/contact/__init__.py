"""Contact: the pressure of an object on the skin."""
