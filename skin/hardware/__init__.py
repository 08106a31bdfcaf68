"""Real skins: reading, recording, calibrating, emulating and watching them."""
