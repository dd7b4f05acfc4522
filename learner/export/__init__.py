"""Networks to ONNX graphs that actors run."""
