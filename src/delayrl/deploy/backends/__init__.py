"""One network, computed by NumPy, ONNX Runtime or JAX."""
