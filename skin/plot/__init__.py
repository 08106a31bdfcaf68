"""Pictures and animations of skins, touches and results."""
