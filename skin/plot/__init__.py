"""Pictures and pages: touches, skins, evaluations, recordings beside their simulation."""
