"""The soft body with its materials and sensors: ``body=`` and ``layout=``."""
