"""The soft body: each module is one choice of ``body=``."""
