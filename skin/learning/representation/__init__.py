"""How readings are shown to a network: each module is one choice of ``representation=``."""
