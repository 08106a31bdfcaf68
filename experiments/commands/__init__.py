"""The verbs of ``skin`` that need a clone of the repository (entry-point group ``skin.verbs``)."""
