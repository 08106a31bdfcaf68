"""Trained networks as ONNX files, which need neither torch nor the run."""
