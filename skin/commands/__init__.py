"""The verbs of the command line: one module each, whose documentation is their help."""
