"""How a trained learner is judged: on devices, layouts and streams, in figures that mean something."""
