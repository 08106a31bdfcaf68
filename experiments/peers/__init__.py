"""Other libraries on the same touches; data go to their environment and back as files."""

PEERS = ("lightgbm", "minirocket", "multirocket_hydra", "ridge")
