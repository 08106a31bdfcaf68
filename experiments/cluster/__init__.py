"""Scripts that start the parts of a cluster on one machine, and checks on them."""
