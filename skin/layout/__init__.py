"""Where the sensors are: each module is one choice of ``layout=``."""
