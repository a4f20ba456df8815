"""What was learned, as ONNX files that run without this project."""
