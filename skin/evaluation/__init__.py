"""Evaluation of trained learners: metrics, operating point, devices, layouts, streams."""
