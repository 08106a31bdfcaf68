"""How time is folded: each module is one choice of ``fusion=``."""
