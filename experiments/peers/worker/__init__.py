"""Models of other libraries, in the environment of these libraries: nothing of ``skin`` is imported here."""
