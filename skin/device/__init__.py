"""Sources of touches: each module is one option of ``device=``."""
