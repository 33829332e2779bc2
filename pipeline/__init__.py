"""The library: data, model, training and evaluation of place recognition on the global batch."""
