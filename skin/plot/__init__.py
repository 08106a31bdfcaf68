"""Pictures and pages of touches, skins, evaluations, and recordings beside their simulation."""
