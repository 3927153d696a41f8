"""The network of a bundle, computed by NumPy, ONNX Runtime or JAX."""
