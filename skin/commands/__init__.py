"""The verbs of ``skin``, one file each."""
