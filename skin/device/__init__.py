"""Where touches come from: each module is one choice of ``device=``."""
