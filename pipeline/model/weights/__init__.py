"""Weights in and out: our files, released files of others, conversion, ONNX."""
